"""The structure derived a second time, by other means."""
