"""Bytes of a URDF -> Robot, with the values of the file."""
