"""Specification of a model from an arm's structure; model in memory, or source of a module, from a specification."""
