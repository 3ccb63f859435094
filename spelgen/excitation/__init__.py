"""Design of motions that excite the dynamic parameters of an arm."""
