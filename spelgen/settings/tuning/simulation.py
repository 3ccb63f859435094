"""Hold the tuned numbers of simulated logs and of motions that are designed."""

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
    sliding_reach: float = 0.5  # [m] to both sides of 0, of sliding joints without limits


@dataclass(frozen=True)
class SimulationTuning:
    """Numbers that decide how exactly motion is simulated, and how arms are controlled."""

    rtol: float = 1e-13  # of integration: as exact as floating-point numbers allow
    atol: float = 1e-14  # [rad, rad/s] likewise
    most_steps: int = 100_000  # while a torque is held: what takes more will not end
    seen_loosening: float = 100.0  # of tolerances where encoders see the motion: 1e-11 is enough
    used_range: float = 0.7  # of a joint's range and of its speed limit, where nothing is said
    integral_gain: float = 0.2  # of the PID: a tenth of what makes a joint without friction unstable
    control_rate: float = 125.0  # [Hz] about, where nothing is said of the controllers


EXCITATION = ExcitationTuning()
SIMULATION = SimulationTuning()
