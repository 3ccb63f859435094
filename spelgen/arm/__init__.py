"""Robot -> Arm: the serial chain in exact rational numbers."""
