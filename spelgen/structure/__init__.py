"""Structure of an arm, derived exactly: zero, constant, varying entries of M, its minimal form, joints affecting V."""
