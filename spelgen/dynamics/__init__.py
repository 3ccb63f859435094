"""Rigid-body dynamics with a common protocol (Pinocchio, regressor, trained models), and kinematics of the tip."""
