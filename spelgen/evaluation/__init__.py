"""A trained model and its rivals, judged on logs."""
