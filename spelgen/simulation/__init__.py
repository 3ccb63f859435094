"""Simulated logs of an arm: motion, drives, friction, encoders; and arms that differ from their URDF."""
