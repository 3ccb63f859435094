"""An Arm to logs: its motion simulated, with drives and friction."""
