"""Train presets on the same logs and compare their errors, for several arms, seeds and splits of the logs."""
