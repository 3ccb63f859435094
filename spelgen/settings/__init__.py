"""The settings file of a robot: values that a URDF cannot express."""
