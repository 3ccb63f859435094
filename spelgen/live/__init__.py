"""Estimator of payload, friction drift and contact that runs on a robot."""
