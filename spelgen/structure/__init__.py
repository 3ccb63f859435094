"""Derive the structure of an arm: zero, constant and varying entries of M and V, and minimal functions for M."""
