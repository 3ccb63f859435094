"""Constants of the design of exciting motions."""

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
    # [1] Triangles of all collision meshes together, of which the convex hulls are made.
    faces: int = 20_000
    # [1] Random positions at which pairs of links are tested for a permanent overlap.
    positions: int = 200
    # [1] Share of these positions from which on a pair of links counts as overlapping permanently, as in MoveIt's setup
    # assistant.
    overlap: float = 0.95
    # [1] Margin of the penalty, relative to the clearance: positions between the samples come closer.
    margin: float = 2.0
    # [1] Weight of the squared violation of the margin by a pair of links at a sample. With 36 shapes of a Panda, 10
    # gives a condition number of 368, 1 of 34, 0.1 of 18, all without a contact.
    collision_penalty: float = 0.1
    # [1] Designs, with other seeds and smaller ranges, until one has no contact.
    attempts: int = 5
    # [1] Factor on the range for each further design.
    range_factor: float = 0.85


TUNING = ExcitationTuning()
