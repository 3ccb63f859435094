"""Simulated logs of an arm: motion, drives, friction, encoders; and simulated arms that differ from their URDF."""
