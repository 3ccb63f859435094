"""Least squares on logs: the rigid-body regressor, friction, base parameters, physically consistent fits."""
