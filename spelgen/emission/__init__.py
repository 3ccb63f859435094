"""A Structure to the source of a module."""
