"""Motions that show an arm's parameters."""
