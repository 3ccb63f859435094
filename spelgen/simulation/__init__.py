"""An Arm to logs: its motion simulated with Pinocchio, drives and friction."""
