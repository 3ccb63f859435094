"""Constants of models: initial values without data in the URDF, and sizes of networks."""

from dataclasses import dataclass


@dataclass(frozen=True)
class ModelTuning:
    """Initial values of drives, servos and friction, and sizes of networks, of an untrained model."""

    # [1] Lower bound of the eigenvalues of M, as a fraction of the smallest nominal eigenvalue over the workspace.
    margin: float = 0.1
    # [1] Typical friction as a fraction of the effort of a drive: gears lose some per cent.
    friction_of_effort: float = 0.02
    # [1] Typical friction as a fraction of the torques of the nominal arm, for a URDF without efforts.
    friction_of_torque: float = 0.1
    # [Nm, N] A larger effort in a URDF is a placeholder.
    largest_effort: float = 1e4
    # [rad/s, m/s] A larger velocity in a URDF is a placeholder.
    largest_speed: float = 100.0
    # [1] Significant digits of inertial parameters: more than the accuracy of a URDF, and few enough to reproduce its
    # decimals.
    inertia_digits: int = 12
    # [1] Smallest second moment of mass about the center of mass, relative to the largest: above the error of rounding.
    min_second_moment: float = 1e-10
    # [1] Mass of a link without mass, as a fraction of the heaviest link.
    default_mass: float = 0.01
    # [rad/s] Speed of a revolute joint without a velocity limit.
    angular_speed: float = 2.0
    # [m/s] Speed of a prismatic joint without a velocity limit.
    linear_speed: float = 0.5
    # [s] Time in which the full effort accelerates the armature to full speed.
    rise: float = 0.02
    # [Nm, N] Effort of a servo without data.
    servo_effort: float = 5.0
    # [rad, m] Distance from the command at which a servo without data has its full effort.
    full_effort_at: float = 0.5
    # [s] Initial ratio kd / kp.
    servo_lag: float = 0.05
    # [1] Armature of a drive without data, as a fraction of the diagonal entry of M.
    min_armature: float = 0.01
    # [1] Scale of positions as inputs of friction networks, relative to velocities.
    position_sensitivity: float = 0.1
    # [1] Hidden units per joint of the friction networks.
    friction_units: int = 8
    # [1] Smallest number of hidden units of the outputs that depend on the same joints.
    min_units: int = 4
    # [1] Smallest number of hidden units of these outputs in Kolmogorov-Arnold networks.
    min_kan_units: int = 2
    # [1] Units of Kolmogorov-Arnold networks as a fraction of the width: each edge has a grid of weights.
    kan_fraction: float = 0.25
    # [1] Units of the network of V, which has one output, as a fraction of the width.
    potential_fraction: float = 0.5


TUNING = ModelTuning()
