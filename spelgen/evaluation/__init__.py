"""A trained model and its baselines, judged on logs."""
