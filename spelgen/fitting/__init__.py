"""Logs and a module to a run folder with a trained model."""
