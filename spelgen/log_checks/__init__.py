"""Checks of logs against their arm, for `spelgen logs`."""
