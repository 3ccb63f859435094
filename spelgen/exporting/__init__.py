"""A trained model -> files that other tools read."""
