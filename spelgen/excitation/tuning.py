"""Constants of the design of exciting motions."""

from dataclasses import dataclass


@dataclass(frozen=True)
class ExcitationTuning:
    """Design of the motion that `spelgen excite` proposes."""

    # [1] Number of random motions. L-BFGS starts from the best one.
    starts: int = 40
    # [1/s] Harmonics per second of duration: the largest frequency is 0.4 Hz. Arms track such motions well, and
    # the frequencies of drive ripple are far higher.
    harmonics_per_second: float = 0.4
    # [1] Smallest number of harmonics, as in Swevers et al., IEEE T-RA 13:730, 1997.
    min_harmonics: int = 5
    # [1] Number of steps from which L-BFGS approximates the curvature.
    history: int = 30
    # [1] Samples per harmonic at which the criterion is evaluated.
    samples_per_harmonic: int = 12
    # [1] Weight of the squared violation of an effort limit at a sample.
    penalty: float = 50.0
    # [1] Largest torque of the URDF's bodies, as a fraction of the effort limit: the rest is reserved for friction.
    effort: float = 0.9
    # [rad/s] Speed limit of revolute joints without a velocity limit.
    revolute_speed: float = 1.0
    # [1] Grid points per period of the highest harmonic, at which limits of the motion are enforced.
    grid: int = 40
    # [m/s] Speed limit of prismatic joints without a velocity limit.
    prismatic_speed: float = 0.25
    # [1] Largest total number of triangles of the collision meshes whose convex hulls are computed.
    faces: int = 20_000
    # [1] Random positions at which pairs of links are tested for a permanent overlap.
    positions: int = 200
    # [1] Smallest fraction of the random `positions` at which a pair of links must be too close to count as
    # permanently overlapping, as in MoveIt's setup assistant.
    overlap: float = 0.95
    # [1] Margin of the penalty divided by the clearance. It exceeds one, since links may be closer between the
    # samples of the penalty.
    margin: float = 2.0
    # [1] Weight of the squared violation of the margin by a pair of links at a sample. Weights of 10, 1 and 0.1
    # give condition numbers of 368, 34 and 18 for a Panda with 36 shapes, all without a contact.
    collision_penalty: float = 0.1
    # [1] Largest number of designs, each with another seed and a smaller range, until one has no contact.
    attempts: int = 5
    # [1] Factor by which the position range is reduced for each further design.
    range_factor: float = 0.85


TUNING = ExcitationTuning()
