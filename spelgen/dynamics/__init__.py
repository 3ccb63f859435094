"""Rigid-body dynamics under one protocol: by Pinocchio, by the regressor, of trained models; tip kinematics."""
