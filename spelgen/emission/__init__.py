"""Derive the specification of a model from the structure of an arm; make a model or the source of a module from it."""
