"""An Arm to its Structure: what of M and V is zero, constant or varying, and the fewest outputs and inputs."""
