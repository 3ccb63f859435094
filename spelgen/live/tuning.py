"""Constants of the estimator; noise levels are found from the training logs (`live.levels`)."""

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import multigammaln


@dataclass(frozen=True)
class LiveTuning:
    """Constants of the estimator, chosen by `benchmarks/live.py`."""

    # Blocks and friction state (`live.estimator`).

    # [s] Length of a block of the drift filter; the payload filter has blocks of twice this length.
    block: float = 0.1
    # [s] Longest time between two samples of a block; a gap makes the friction state unknown.
    gap: float = 0.25
    # [1] A sample whose positions change faster than this multiple of the largest speed of the training logs is
    # refused.
    jump: float = 10.0
    # [1] Refused samples in a row after which the estimator restarts at the new positions.
    restart: int = 5
    # [1] A joint is at rest below this fraction of its largest speed in the training logs.
    rest: float = 0.01

    # Filters (`live.filters`).

    # [kg, kg m, kg m^2] Prior standard deviations of mass, first moments and inertia of a payload of 10 kg. The report
    # removes this prior: larger ones only add rounding errors.
    load_mass: float = 10.0
    load_moment: float = 2.0
    load_inertia: float = 0.4
    # [1] Prior standard deviation of the friction scale.
    friction: float = 0.02
    # [1/s] Variance per second of the random walk of the friction scale.
    friction_walk: float = 3e-5
    # [1] Prior standard deviation of the torque offset, relative to the effort limit.
    offset: float = 0.01
    # [1] Residuals beyond this number of standard deviations have a larger noise (Huber, Robust Statistics, 1981).
    outlier: float = 3.0
    # [1] Factor on the variance of friction whose state is unknown: a uniform distribution has 1/3 of the squared
    # half width; friction within it is correlated over a block.
    uncertainty: float = 3.0

    # Changed loads (`live.estimator`).

    # [1] Number of standard deviations above which the squared residuals of a block start the hypothesis of a changed
    # load.
    surprise: float = 3.0
    # [1] Factor on the standard deviation of the disturbance under the hypothesis of a contact.
    contact_disturbance: float = 8.0
    # [1] Log likelihood ratio, and [s] time in motion, from which on a changed load is accepted.
    changed: float = 15.0
    changed_after: float = 1.0
    # [s] Time in motion after which the hypotheses are dropped; after `changed_after` if the log likelihood ratio is
    # below `unlikely`.
    unlikely: float = -8.0
    dropped_after: float = 4.0

    # Contacts (`live.contact`).

    # [1/s] Bandwidth of the momentum observer.
    bandwidth: float = 20.0
    # [1] Smallest standard deviation of the momentum observer, relative to the effort of a joint: logs without noise
    # give positive thresholds.
    min_observer_noise: float = 1e-3
    # [s] Time constant at which the disturbance is removed from the external torque: longer than it takes to find a
    # contact, so that the disturbance does not absorb the contact.
    baseline: float = 0.3
    # [1] Factor on the thresholds: errors of models are larger on other days than between training logs.
    other_days: float = 1.22
    # [1/min] Default rate of false alarms.
    alarms_per_minute: float = 1.0
    # [s] Window of the peaks from which thresholds are found, and the fraction of the peaks in the exponential tail.
    window: float = 0.5
    tail: float = 0.2

    # Payload (`live.payload`).

    # [s] Time in motion between two reports of the payload.
    report: float = 1.0
    # [m] Radius of gyration and distance along z of the prior mean of a payload.
    radius: float = 0.2
    distance: float = 0.05
    # [kg] Masses of the prior means that are compared.
    scales: tuple[float, ...] = (0.125, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0)
    # [1] Log odds of "no payload" below which a payload is reported, and above which there is none.
    payload_odds: float = -5.0
    no_payload_odds: float = 3.0

    # [1] Degrees of freedom of the Wishart prior of the pseudo-inertia.
    degrees: int = 6
    # [1] Newton's method with an increasing weight of the likelihood: number of weights 4^-k below one, and largest
    # number of steps for each.
    weights: int = 12
    iterations: int = 40
    # [s] Predictions up to this time ahead contain the disturbance.
    disturbance_ahead: float = 0.3

    # Noise levels (`live.levels`).

    # [1] Folds of the logs, samples of motion that a fit to the others needs, and samples that it uses at most.
    folds: int = 3
    min_samples: int = 300
    max_samples: int = 2**11
    # [s] Time constants of the disturbance that are compared, and [1] its standard deviation divided by the one of
    # white noise.
    time_constants: tuple[float, ...] = (0.1, 0.2, 0.4, 0.8, 1.6, 3.2, 6.4)
    disturbance_ratios: tuple[float, ...] = (0, 0.25, 0.5, 0.75, 1, 1.5, 2, 3, 5)
    # [1] Lengths of the trials of the payload filter, in blocks: 5 and 10 s.
    trial_blocks: tuple[int, ...] = (25, 50)
    # [1] Prior of the factor on the covariance of payloads, and the number of trials that it counts as: arms with few
    # logs have too few trials of their own.
    prior_variance: float = 2.25
    prior_trials: int = 4
    # [1] Speeds below which friction errs more that are compared, relative to the largest speed, and ratios of the
    # noise at rest to that in motion.
    resting_speeds: tuple[float, ...] = (0.01, 0.02, 0.05, 0.1, 0.2)
    resting_ratios: tuple[float, ...] = (0, 1, 2, 4, 8, 16)

    # Reports (`live.replay`).

    # [s] Contacts closer than this are one.
    merged: float = 0.2

    @property
    def load_prior(self) -> np.ndarray:
        """Prior standard deviations of the inertial parameters of a payload, (10,)."""
        return np.repeat([self.load_mass, self.load_moment, self.load_inertia], [1, 3, 6])

    @property
    def evidence(self) -> float:
        """Constant of the log evidence: of the Wishart density, with |dJ/dtheta| = 1/2, and of Laplace's Gaussian."""
        wishart = 2 * self.degrees * math.log(2) + float(multigammaln(self.degrees / 2, 4))
        return 5 * math.log(2 * math.pi) - math.log(2) - wishart


TUNING = LiveTuning()
