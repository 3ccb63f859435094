"""Fit arms under position servos to logs of commanded positions."""
