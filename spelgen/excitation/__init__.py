"""Motions that excite the parameters of an arm."""
