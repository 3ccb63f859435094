"""Constants of fits to torques."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from spelgen.settings.fits import Adaptation, GaussianPrior

DAY_TO_DAY = {
    "sizes": 0.1,
    "velocities": 0.1,
    "fractions": 0.1,
    "shared_sizes": 0.1,
    "shared_velocities": 0.1,
    "shared_fractions": 0.1,
    "shared_friction": 0.3,
}


@dataclass(frozen=True)
class TorqueTuning:
    """Fits of rigid bodies to torques (`fitting.torque`)."""

    decimation: int = 2  # samples at 100 Hz, filtered at 8 Hz: every second one says all that is to be said
    # samples, 0.06 s: so many in a row err alike and count once, as white noise does after the filter. Of 5, M(q) of
    # arms whose truth is known is 5 % worse, seconds of real logs do better (UR10e, 3 s: nMSE 0.0080 -> 0.0062).
    # Estimates from what a fit misses drive themselves up: a joint that is missed counts less, and is missed more
    # (Panda: 0.0015 -> 0.0030)
    correlation_length: float = 3.1
    lasting_errors: float = 5.0  # samples, 0.1 s: likewise where forms of friction and functions are judged
    rounds: int = 5  # after the first ones, of finding noise and prior anew
    # twice the logarithm of a likelihood ratio: strong evidence (Kass and Raftery, J. Am. Stat. Assoc. 90:773, 1995)
    strong_evidence: float = 6.0
    # likewise, which Stribeck effect, saturation and dependence on load of a joint have to gain (2 for a parameter:
    # Akaike, IEEE Trans. Autom. Control 19:716, 1974)
    effects_evidence: float = 2.0
    first_steps: int = 60  # at most, before noise and prior are found
    first_rounds: int = 12  # at most, while noise falls to that of least squares
    # [1] of what is missed (a low_cost_robot from placeholders: M(q) 0.44 -> 0.005)
    first_noise: float = 0.03
    last_rounds: int = 2  # where all but the last digits are fitted, and of least squares
    longer: int = 4  # times as many rounds at most, while some joint's noise falls
    noise_settled: float = 0.98  # [1] noise by that of the round before: what falls by less is settled
    steps: int = 5  # at most in a round
    gain: float = 1e-4  # [1] of the cost: a step that gains less ends a round
    turns: int = 3  # of rigid bodies and what stands beside them
    subset: int = 2**10  # samples, evenly spread, that come near; all of them finish
    windows: int = 2**12  # at most, of 5 samples, that say how far joints move
    measured_windows: int = 2**8  # at most, of validation, that the model is measured on after the fit
    residual_samples: int = 2**14  # that what stands beside rigid bodies is selected on
    seen: float = 1e-10  # [1] of the largest curvature: directions with less are not seen in the samples
    # [1] of it: noise-free samples are fitted to four digits of their torque's range
    least_noise: float = 1e-4
    least_left: float = 0.1  # [1] of independent errors, however many weights a torque determines
    # [1] of the missed squares, by a drive that adds torque with velocity
    compensation_explained: float = 0.1
    compensation_deviations: float = 4.0  # standard deviations that such a slope has to be away from zero
    # [1] of the torque's deviation: delays of milliseconds look alike, but smaller
    compensation_visible: float = 0.05
    block: int = 2**13  # samples at a time: of seven joints some 100 MB with their derivatives
    regressor_bytes: float = 4e8  # [B] of regressors: 70,000 samples of six joints; of more, every so many
    in_memory: int = 2**18  # samples of logs larger than memory: 140 MB of six joints
    body_step: float = 0.3  # [1] of the way to the border of the possible bodies, at most in a step
    # by what is adapted, about the run. Load: known to a factor of twenty in mass (10 in place of 3 let half a second
    # of motion err by 27 times the variance of the torque, UR10e). Friction: warmth changes that of all joints by tens
    # of per cent, of a joint by itself less (Bittencourt and Gunnarsson, J. Dyn. Sys. Meas. Control 134:051013, 2012).
    # Units of one make differ by a few per cent in mass, too
    priors: Mapping[Adaptation, GaussianPrior] = field(
        default_factory=lambda: {
            "load": GaussianPrior(bodies=3.0),
            "friction": GaussianPrior(**DAY_TO_DAY),
            "unit": GaussianPrior(**DAY_TO_DAY, bodies=0.1, gains=0.1, armature=0.1, shared_armature=0.1),
        }
    )


@dataclass(frozen=True)
class ResidualTuning:
    """Selection of what stands beside rigid bodies (`fitting.torque.selection`)."""

    folds: int = 10  # blocks of samples that are held out in turn
    gap: float = 5.0  # [1] of the samples that err alike, 0.3 s: left out between fitted and held-out samples
    # of a block's mean gain: 1 % of luck, by Student's t of nine degrees of freedom
    standard_errors: float = 2.82
    least_gain: float = 1e-3  # [1] of the squares that are missed: what explains less is not worth a function
    # [1] of what the best function so far leaves: a later one has to leave less than that
    clearly_less: float = 0.9
    rounds: int = 30  # of the marginal likelihood's fixed point, at most
    converged: float = 1e-3  # [1] relative change of the noise
    network_samples: int = 2**12  # that networks are fitted to
    network_first_look: int = 20  # evaluations of its loss: a network that then explains nothing is left out
    network_evaluations: int = 100  # of its loss


@dataclass(frozen=True)
class TorqueReportTuning:
    """When a fit to torques warns (`fitting.torque.report`)."""

    # [1] relative standard deviation from which on logs do not determine an inertia
    undetermined: float = 0.5
    # [1] torque missed, by what accelerates a joint: beyond, motion is hardly predicted
    weak_acceleration: float = 2.0
    positions: int = 50  # at which inertias are looked at
