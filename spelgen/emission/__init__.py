"""Specification of a model from the structure of an arm; model in memory, or source of a module, from a specification."""
