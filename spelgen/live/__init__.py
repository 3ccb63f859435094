"""Online estimator of payload, friction drift and contact."""
