"""Constants of untrained models: initial values that the URDF does not contain, and numbers of hidden units."""

from dataclasses import dataclass


@dataclass(frozen=True)
class ModelTuning:
    """Constants for untrained models: initial drives, servos and friction, and numbers of hidden units of networks."""

    # [1] Lower bound of the eigenvalues of a trained M, divided by the smallest eigenvalue of the nominal M at random
    # positions. These eigenvalues are generalised ones, relative to the mean of the nominal M.
    margin: float = 0.1
    # [1] Typical friction, divided by the effort limit of the drive: gears lose some per cent of the torque.
    friction_of_effort: float = 0.02
    # [1] Typical friction, divided by the joint's typical torque for gravity and unit acceleration, for joints without
    # an effort limit.
    friction_of_torque: float = 0.1
    # [Nm, N] A larger effort limit in a URDF is regarded as a placeholder for an unknown limit.
    largest_effort: float = 1e4
    # [rad/s, m/s] A larger velocity limit in a URDF is regarded as a placeholder for an unknown limit.
    largest_speed: float = 100.0
    # [1] Significant digits of inertial parameters: more than the accuracy of a URDF, and few enough that the
    # decimals of a URDF are reproduced.
    inertia_digits: int = 12
    # [1] Smallest allowed principal second moment of mass of a body about its center of mass, divided by the largest:
    # large enough that rounding errors do not make the body physically inconsistent.
    min_second_moment: float = 1e-10
    # [rad/s] Typical speed of a revolute joint without a velocity limit.
    angular_speed: float = 2.0
    # [m/s] Typical speed of a prismatic joint without a velocity limit.
    linear_speed: float = 0.5
    # [s] Time in which the effort limit accelerates the armature of a drive with unknown rotor inertia to full speed:
    # the armature is initially this time * effort / speed.
    rise: float = 0.02
    # [Nm, N] Full effort of a servo without an effort limit, which determines the initial kp.
    servo_effort: float = 5.0
    # [rad, m] Position error at which a servo with unknown kp initially has its full effort.
    full_effort_at: float = 0.5
    # [s] Initial ratio kd / kp of a servo.
    servo_lag: float = 0.05
    # [1] Armature of a drive of unknown rotor inertia, effort or speed, divided by the joint's diagonal entry of the
    # nominal M.
    min_armature: float = 0.01
    # [1] Factor on the encoded positions that are inputs of friction networks: positions are initially weaker inputs
    # than velocities, which are divided by typical speeds and are of the order of one.
    position_sensitivity: float = 0.1
    # [1] Number of hidden units per joint of the friction networks.
    friction_units: int = 8
    # [1] Smallest number of hidden units per group of outputs (of a network) that depend on the same joints.
    min_units: int = 4
    # [1] Smallest number of hidden units per group of outputs of a Kolmogorov-Arnold network, whose units have a
    # learned function per edge.
    min_kan_units: int = 2
    # [1] Number of hidden units of Kolmogorov-Arnold networks, divided by the number for multilayer perceptrons (the
    # option `width`); smaller, because each edge has several weights.
    kan_fraction: float = 0.25
    # [1] Number of hidden units of the network of V, divided by the number of the network of M; smaller, because V is a
    # single output.
    potential_fraction: float = 0.5


TUNING = ModelTuning()
