"""Models from arms: derive a ``ModelSpec`` from an arm's structure, and make a model or a module's source from it."""
