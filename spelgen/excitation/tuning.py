"""Constants of the design of exciting motions."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class ExcitationTuning:
    """Numbers that decide which motion `spelgen excite` proposes."""

    starts: int = 40  # motions at random, of which the best is improved
    harmonics_per_second: float = 0.4  # up to 0.4 Hz: what an arm follows well, far below its drives' ripple
    fewest_harmonics: int = 5  # as in Swevers et al. 1997
    memory: int = 30  # steps from which L-BFGS knows the curvature
    samples_per_harmonic: int = 12  # of a motion that is tried
    penalty: float = 50.0  # on the squared part of an effort limit that a sample overruns
    effort: float = 0.9  # of the effort limits: friction comes on top of what the URDF says
    usual_speed: float = 1.0  # [rad/s] where the URDF names no limit
    grid: int = 40  # points for each harmonic, between which a motion keeps its limits
    sliding_speed: float = 0.25  # [m/s] likewise, of sliding joints


TUNING = ExcitationTuning()
