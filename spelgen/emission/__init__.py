"""Structure -> specification of a model -> model in memory, or the source of a module."""
