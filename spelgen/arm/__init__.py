"""A Robot to an Arm: the serial chain in exact rational numbers."""
