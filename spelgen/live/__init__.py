"""Online estimator for a fitted arm: payload, drift of friction, and contacts, from measured q, qd and torque."""
