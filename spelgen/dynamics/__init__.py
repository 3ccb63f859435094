"""What has rigid-body dynamics, under one protocol: Pinocchio's view of an arm, the regressor; and the tip."""
