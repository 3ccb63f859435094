"""Constants of the integration of baselines and models."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class PredictorTuning:
    """Constants of the Rosenbrock integration of predictions."""

    most_substeps: int = 16  # of dynamics between samples; a power of two
    shortest_step: float = 1e-3  # [s] of dynamics: shorter ones are for those that leave all bounds
    # of the error of dynamics, what twice as many steps may change: figures move by a thousandth
    tolerance: float = 5e-2
    least_error: float = 2e-5  # of the motion: dynamics are not expected to be better
    probed_windows: int = 16  # that say in which steps dynamics are integrated
    bounds: float = 100.0  # times the largest velocity that was measured: what is faster has left all bounds
    # of a joint's largest velocity: differences that friction is differentiated by
    velocity_step: float = 1e-5
    displacement_step: float = 1e-7  # [rad, m] likewise, of bristles


@dataclass(frozen=True)
class PositionActuatorTuning:
    """Decide how MuJoCo's position actuators are fitted, the baseline of servo fits."""

    step: float = 5e-3  # [s] at most; frictionloss is as hard as twice this allows
    windows: int = 60  # half a minute of fitting
    iterations: int = 8  # of mujoco.minimize
    nudge: float = 1e-4  # of unknowns, for slopes


TUNING, ACTUATORS = PredictorTuning(), PositionActuatorTuning()
