"""Arm -> Structure: zero, constant and varying entries of M and V, and a minimal set of functions for M."""
