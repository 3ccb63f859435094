"""Tuned numbers of modules: where a model starts where the URDF says nothing, and how large its networks are."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class ModelTuning:
    """Hold the sizes that an untrained model takes from the arm: of drives, servos and networks."""

    margin: float = 0.1  # [1] of M's least eigenvalue over the workspace: from there on M is kept as it is
    friction_of_effort: float = 0.02  # [1] usual friction by a drive's effort: gears lose some per cent
    friction_of_torque: float = 0.1  # [1] the same by the torques of the nominal arm, without an effort
    largest_effort: float = 1e4  # [Nm, N] what stands above is a placeholder
    largest_speed: float = 100.0  # [rad/s, m/s] likewise
    usual_turning: float = 2.0  # [rad/s] of a joint without a limit
    usual_sliding: float = 0.5  # [m/s] likewise
    rise: float = 0.02  # [s] in which full effort brings a drive's own inertia to full speed
    servo_effort: float = 5.0  # [Nm, N] of a servo of which nothing is said
    full_effort_at: float = 0.5  # [rad, m] from the command, of such a servo
    servo_lag: float = 0.05  # [s] kd by kp, to start from
    least_armature: float = 0.01  # [1] of an entry of M, where nothing is known of the drive
    position_sensitivity: float = 0.1  # [1] of friction's networks, relative to velocity
    friction_units: int = 8  # [1] hidden units of the network of one joint's friction
    least_units: int = 4  # [1] hidden units of the outputs that read the same joints
    least_kan_units: int = 2  # [1] the same of Kolmogorov-Arnold networks
    kan_fraction: float = 0.25  # [1] of the width: each of their edges has a grid of numbers
    potential_fraction: float = 0.5  # [1] of the width, of the network of V: one output


TUNING = ModelTuning()
