"""Train presets on the same logs and compare them: arms x presets x seeds x splits."""
