"""Fit inverse dynamics to the torques of logs."""
