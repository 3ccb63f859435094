"""Read a URDF into a `Robot` that has the values of the file, unchanged."""
