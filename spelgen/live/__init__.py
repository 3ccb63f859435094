"""Estimator of payload, friction drift and contact that runs beside the robot."""
