"""A URDF's bytes to a Robot, exactly as written."""
