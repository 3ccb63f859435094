"""Least squares on logs: friction, base parameters, physically consistent fits."""
