"""Baselines: simple predictors with which a fitted model is compared."""
