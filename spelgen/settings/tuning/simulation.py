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


@dataclass(frozen=True)
class AsBuiltTuning:
    """How far an arm as built differs from its URDF; pairs are the bounds of uniform distributions."""

    # Relative standard deviation of masses, inertias and, by the radius of gyration, centres of mass.
    inertial_error: float = 0.3
    # Coulomb friction, relative to the rigid-body torque of moderate motion, and its asymmetry between directions.
    coulomb: tuple[float, float] = (0.04, 0.12)
    asymmetry: float = 0.1
    # Viscous friction at moderate speed, relative to Coulomb friction.
    viscous: tuple[float, float] = (0.3, 1.0)
    # Armature, relative to the mean diagonal entry of M.
    armature: tuple[float, float] = (0.02, 0.2)
    # Moderate motion: angular frequency [rad/s] that turns a speed into an acceleration.
    acceleration: float = 2.0
    # Random positions, and the fraction of the joint ranges they cover, from which magnitudes are computed.
    positions: int = 50
    range_fraction: float = 0.7
    # Presliding of gears [rad]: largest breakaway displacement, ratio of largest to smallest, number of elements.
    presliding: float = 0.03
    presliding_span: float = 150.0
    elements: int = 5
    # White noise of the torque sensors, relative to the standard deviation of the torque.
    torque_noise: float = 0.02
    # Encoders of 19 bits [rad; m].
    resolution: float = 1.2e-5
    # Recordings [s], [Hz].
    duration: float = 15.0
    sample_rate: float = 200.0


EXCITATION = ExcitationTuning()
SIMULATION = SimulationTuning()
AS_BUILT = AsBuiltTuning()
