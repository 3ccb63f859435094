"""Evaluation of a trained model and its baselines on test logs."""
