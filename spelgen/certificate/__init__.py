"""The derived structure of an arm for users: facts with geometric reasons, formulas of M and V, numerical checks."""
