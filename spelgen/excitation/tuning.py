"""Constants of the design of exciting motions."""

from dataclasses import dataclass


@dataclass(frozen=True)
class ExcitationTuning:
    """Constants of the design of the motion that `spelgen excite` proposes."""

    # [1] Number of random motions. L-BFGS starts from the random motion with the smallest criterion.
    starts: int = 40
    # [1/s] Number of harmonics divided by the duration, which is the frequency of the highest harmonic. Arms track
    # motions of such low frequencies well. Torque ripple of the drives has far higher frequencies.
    harmonics_per_second: float = 0.4
    # [1] Smallest number of harmonics, as in Swevers et al., IEEE T-RA 13:730, 1997.
    min_harmonics: int = 5
    # [1] Number of steps from which L-BFGS approximates the curvature.
    history: int = 30
    # [1] Decimal places to which the optimizer rounds the parameters, the criterion and its gradient. Rounding errors
    # of processors are far smaller, and the parameters of random motions have a standard deviation of one.
    decimals: int = 6
    # [1] Number of samples of a motion at which the criterion is evaluated, divided by the number of harmonics.
    samples_per_harmonic: int = 12
    # [1] Weight, in the criterion, of the squared excess of a torque over the fraction `effort` of its limit.
    penalty: float = 50.0
    # [1] Largest rigid-body torque without a penalty, divided by the effort limit. The rest is reserved for friction.
    effort: float = 0.9
    # [rad/s] Speed limit of revolute joints without a velocity limit.
    revolute_speed: float = 1.0
    # [1] Grid points per period of the highest harmonic, at which limits of the motion are enforced.
    grid: int = 40
    # [m/s] Speed limit of prismatic joints without a velocity limit.
    prismatic_speed: float = 0.25
    # [1] Largest total number of triangles of the collision meshes whose convex hulls are computed.
    faces: int = 20_000
    # [1] Number of random positions at which pairs of links are tested for a permanent overlap.
    positions: int = 200
    # [1] A pair of links is not compared if it is too close at this fraction of the random `positions` or more, as in
    # MoveIt's setup assistant.
    overlap: float = 0.95
    # [1] Distance below which the criterion has a penalty, divided by the clearance. The number is greater than one,
    # because the penalty is computed only at samples, between which distances may be smaller.
    margin: float = 2.0
    # [1] Weight in the criterion of the penalty on small distances between links, and of links from the surroundings.
    # Weights of 10, 1 and 0.1 give condition numbers of the base regressor of 368, 34 and 18 for a Panda with 36
    # collision shapes; no motion has a contact.
    collision_penalty: float = 0.1
    # [1] Largest number of designs, each with another seed and a smaller range, until one has no contact.
    attempts: int = 5
    # [1] After a design with a contact, the range of positions of the next design is multiplied by this factor.
    range_factor: float = 0.85


TUNING = ExcitationTuning()
