"""Measured or simulated motions: read, mapped, checked, filtered, cut into windows, and reported on."""
