"""Constants of the integration of baselines and models."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class PredictorTuning:
    """Integration of predictions by the Rosenbrock method."""

    # [1] Largest number of steps between samples; a power of two.
    most_substeps: int = 16
    # [s] Shortest step: only dynamics that diverge would need shorter ones.
    shortest_step: float = 1e-3
    # [1] Change by twice as many steps that is allowed, relative to the error of the dynamics: reported figures
    # change by a thousandth.
    tolerance: float = 5e-2
    # [1] Smallest expected error of dynamics, relative to the motion.
    least_error: float = 2e-5
    # [1] Windows on which the number of steps is chosen.
    probed_windows: int = 16
    # [1] Multiple of the largest measured velocity beyond which a prediction has diverged.
    bounds: float = 100.0
    # [1] Finite-difference step of friction with respect to velocity, as a fraction of a joint's largest velocity.
    velocity_step: float = 1e-5
    # [rad, m] Finite-difference step of friction with respect to the displacement of bristles.
    displacement_step: float = 1e-7


@dataclass(frozen=True)
class PositionActuatorTuning:
    """Fit of MuJoCo's position actuators, the baseline of servo fits."""

    # [s] Largest step; the time constant of frictionloss is twice this value.
    step: float = 5e-3
    # [1] Windows that are fitted: half a minute of computation.
    windows: int = 60
    # [1] Iterations of mujoco.minimize.
    iterations: int = 8
    # [1] Finite-difference step of the unknowns.
    nudge: float = 1e-4


TUNING, ACTUATORS = PredictorTuning(), PositionActuatorTuning()
