"""What has M, gravity and friction: Pinocchio's view of an arm or a URDF, the regressor, the tip."""
