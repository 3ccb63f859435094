"""Logs of measured or simulated motion: reading, mapping, checks, filters and windows."""
