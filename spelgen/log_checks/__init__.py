"""Checks of logs against the arm that they were recorded on, for `spelgen logs`."""
