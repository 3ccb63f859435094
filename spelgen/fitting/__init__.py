"""Fits of a module to logs, written to a run folder."""
