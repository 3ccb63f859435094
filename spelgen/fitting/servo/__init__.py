"""Fits of arms with position servos to logs of commanded and measured positions."""
