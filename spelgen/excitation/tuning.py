"""Constants of the design of exciting motions."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class ExcitationTuning:
    """Design of the motion that `spelgen excite` proposes."""

    # [1] Random motions, of which the best one is improved.
    starts: int = 40
    # [1/s] Harmonics per second of motion, so that frequencies reach 0.4 Hz: arms track them well, and drive ripple
    # is far above.
    harmonics_per_second: float = 0.4
    # [1] Smallest number of harmonics, as in Swevers et al., IEEE T-RA 13:730, 1997.
    min_harmonics: int = 5
    # [1] Number of steps from which L-BFGS approximates the curvature.
    history: int = 30
    # [1] Samples per harmonic of a motion that is evaluated.
    samples_per_harmonic: int = 12
    # [1] Weight of the squared violation of an effort limit at a sample.
    penalty: float = 50.0
    # [1] Fraction of the effort limits that may be used: friction is added to the URDF's torques.
    effort: float = 0.9
    # [rad/s] Speed limit of revolute joints without a velocity limit.
    revolute_speed: float = 1.0
    # [1] Points per harmonic at which limits of the motion are enforced.
    grid: int = 40
    # [m/s] Speed limit of prismatic joints without a velocity limit.
    prismatic_speed: float = 0.25


TUNING = ExcitationTuning()
