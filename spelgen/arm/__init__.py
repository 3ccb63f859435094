"""Derive an arm from a robot: the serial chain in exact rational numbers, and the input matrix of its motors."""
