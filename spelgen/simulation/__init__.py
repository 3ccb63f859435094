"""Simulation of logs of an arm, with drives, friction and encoders, also for arms that differ from their URDF."""
