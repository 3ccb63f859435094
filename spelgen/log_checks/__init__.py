"""Logs are held against the arm that they come from, for `spelgen logs`."""
