"""Logs held against the arm they come from: gravity, following of commands, statistics, and the report of `spelgen logs`."""
