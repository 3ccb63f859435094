"""Dynamics of arms with a common interface (Pinocchio, regressor, trained models), and kinematics of the tip."""
