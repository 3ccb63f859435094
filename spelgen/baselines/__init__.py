"""Predictors that a fitted model is compared with."""
