"""Fit windows of logs: the weak form of the equations, and rollouts."""
