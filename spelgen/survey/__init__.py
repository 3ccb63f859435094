"""Logs beside a robot: what they hold, and what to doubt."""
