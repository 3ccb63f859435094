"""Structure of an arm, derived exactly: zero, constant and varying entries of M, joints of V, minimal form of M."""
