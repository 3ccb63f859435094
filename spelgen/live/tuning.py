"""Constants of the online estimator, except for noise levels, which `live.levels` estimates from training logs."""

import math
from dataclasses import dataclass

from scipy.special import multigammaln


@dataclass(frozen=True)
class LiveTuning:
    """Constants of the online estimator of payload, friction drift and contacts, chosen by `benchmarks/live.py`."""

    # Constants of blocks and of the friction state (`live.estimator`).

    # [s] Length of a block of the drift filter; the payload filter has blocks of twice this length.
    block: float = 0.1
    # [s] Longest time between two samples of a block. After a longer gap the friction state is unknown.
    gap: float = 0.25
    # [1] A sample is refused if its velocity, or the change of position since the last sample divided by the time,
    # exceeds this multiple of the largest speed of the training logs. If the torque limit of a joint is unknown, a
    # torque counts as saturated if it is at least this multiple of `NoiseLevels.effort`, a guess of the limit.
    jump: float = 10.0
    # [1] Number of consecutive refused samples after which the estimator restarts at the new positions.
    restart: int = 5
    # [1] Number of samples that a `DelayLine` stores per delay: a sample is stored only if at least the time delay /
    # `delay_samples` has passed since the last stored sample.
    delay_samples: int = 16
    # [1] A joint is at rest below this fraction of its largest speed in the training logs.
    rest: float = 0.01

    # Constants of the filters (`live.filters`).

    # Prior standard deviations of the payload's inertial parameters in the payload filter: mass [kg], three first
    # moments [kg m] and six elements of the inertia [kg m^2]. The filter's prior is removed from the final estimate, so
    # a wider prior would only add rounding errors.
    load_prior: tuple[float, ...] = (10.0, *(2.0,) * 3, *(0.4,) * 6)
    # [1] Prior standard deviation of the friction scale, current friction divided by friction of the model.
    friction: float = 0.02
    # [1/s] Increase of the variance of the friction scale per second, as a random walk.
    friction_walk: float = 3e-5
    # [1] Prior standard deviation of the torque offset, relative to the effort limit. In recordings outside
    # of the training logs, offsets have a root mean square of 0.0004 to 0.004 per arm, and are at most 0.01.
    # With 0.003, offsets of 0.004 give a payload of 2 kg in 5 % of the logs of a UR10e.
    offset: float = 0.005
    # [1] Residuals beyond this number of standard deviations are treated as outliers, with a larger noise variance
    # (Huber, Robust Statistics, 1981).
    outlier: float = 3.0
    # [1] Variance of the friction torque of a joint whose friction state is unknown, divided by the square of
    # `Balance.uncertainty`, half the range of this torque. The value would be 1/3 for a uniform distribution over the
    # range. It is larger, because samples are averaged in blocks, and the errors in a block are correlated.
    uncertainty: float = 3.0

    # [1] Standard deviation of the error of a payload's torque, relative to the torque. Such errors (from noise of the
    # velocity, and friction that depends on the load) are not in training logs, which have no payload. With 0, heavy
    # loads of simulated arms with accurate sensors have a large `misfit` and are never reported.
    load_error: float = 0.03

    # [1] Fraction of the variance of torque errors that is the same in each repetition of a motion, and is therefore
    # not averaged out by more motion. The variance of the torque of the estimated payload has a lower bound: this
    # fraction times the variance of torque errors. Without the bound, the normalised squared error of a payload that is
    # estimated for an arm without payload increases with time, to 20 after ten minutes of repeated logs of a UR10e.
    # The fraction 0.03 is too small: after 20 minutes of repeated logs, it gives payloads of 6 to 60 g for other arms.
    recurring: float = 0.1

    # Constants of the detection of changed loads (`live.filters.PayloadEstimate`).

    # [1] The filters for the two hypotheses, a changed load and a contact, are started if the sum of the squared
    # residuals of a block exceeds its expected value by this number of its standard deviations.
    surprise: float = 3.0
    # [1] Standard deviation of the disturbance under the hypothesis of a contact, divided by the larger one of the
    # standard deviations of disturbance and white noise. Logs of some arms have no disturbance.
    contact_disturbance: float = 8.0
    # A changed load is accepted after `changed_after` [s] of motion or later, if the log likelihood of the hypothesis
    # "changed load" exceeds the log likelihoods of "no change" and of "contact" by more than `changed` [1].
    changed: float = 15.0
    changed_after: float = 1.0
    # The hypotheses "changed load" and "contact" are dropped together: "contact" serves only for comparison. They are
    # dropped after `dropped_after` [s] of motion. They are dropped earlier, after `changed_after` [s], if "changed
    # load" is unlikely: if its log likelihood minus the larger one of "contact" and "no change" is below `unlikely`
    # [1].
    unlikely: float = -8.0
    dropped_after: float = 4.0

    # Constants of the detection of contacts (`live.contact`).

    # [1/s] Bandwidth of the momentum observer.
    bandwidth: float = 20.0
    # [1] If measured torques lag behind the motion, the torque residual has an error while dp/dt changes (p: momentum).
    # The standard deviation of this error is assumed to be `jerk` times the difference of two estimates of dp/dt: one
    # with the bandwidth B = 20/s of the observer, one with 2 B. The first estimate lags by 1 / B = 50 ms, the second by
    # 25 ms. Their difference is the change of dp/dt in 25 ms, the error for torques that lag by 25 ms. `jerk` = 0.5
    # assumes half this lag, 12 ms.
    jerk: float = 0.5
    # `ContactObserver.level` is a mean of squared normalised residuals. `level` [s] is the time constant of this mean,
    # and `level_limit` [1] the upper limit of a square in it. In recordings of an AIRBOT, the first joint vibrates at 6
    # Hz in some motions. Of the contacts with 10 % of the effort limit, 73 % are detected within 150 ms. If thresholds
    # do not depend on the level, 60 % are detected at the same rate of false alarms.
    level: float = 0.5
    level_limit: float = 4.0
    # [1] Lower bound of the standard deviation of the momentum observer, relative to the torque limit of a joint, so
    # that logs without noise give positive thresholds.
    min_observer_noise: float = 1e-3
    # [s] Time constant of the low-pass filter of the estimated disturbance, which is subtracted from the external
    # torque. Contacts are detected in less time, so that they are not subtracted with the disturbance.
    baseline: float = 0.3
    # [1] The errors of a model are larger on other days than in the training logs. Thresholds from the training logs,
    # and standard deviations of payloads, are therefore enlarged by at least this factor.
    other_days: float = 1.3
    # [1/min] Default rate of false contact alarms.
    alarms_per_minute: float = 1.0
    # Thresholds are computed from peaks, the largest residuals in time windows of `window` [s]. The largest peaks, a
    # fraction `tail` [1] of all, are modelled by an exponential distribution.
    window: float = 0.5
    tail: float = 0.2

    # Constants of the estimate of the payload (`live.payload`).

    # [s] Time in motion between two reports of the payload.
    report: float = 1.0
    # [m] The prior mean of a payload is a homogeneous ball of the radius `radius`, with its centre on the z axis of the
    # last body at the distance `distance` from the origin.
    radius: float = 0.2
    distance: float = 0.05
    # [kg] The prior of a payload is a mixture of distributions with equal probabilities. Each number is the mass of the
    # ball that is the mean of one distribution.
    scales: tuple[float, ...] = (0.125, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0)
    # [1] Limits of the log odds of "no payload" against a payload. A payload is reported if the log odds are at most
    # `payload_odds`, "no payload" if they are greater than `no_payload_odds`. Between the limits, the status is "not
    # yet".
    payload_odds: float = -5.0
    no_payload_odds: float = 3.0

    # [1] A new payload is reported only if the mean normalised squared residual of the payload filter
    # (`PayloadEstimate.misfit`) is at most `misfit`. A contact gives larger residuals, since no payload explains its
    # torques. On a UR10e the residual is 0.5 to 2.2 with a payload, and 3.7 to 59 with a contact.
    misfit: float = 3.0

    # [1] Degrees of freedom of the Wishart prior of the payload's pseudo-inertia.
    degrees: int = 6
    # [1] Newton's method for the payload increases the weight of the likelihood from 4^-weights to 1 by factors of 4,
    # with at most `iterations` steps for each weight.
    weights: int = 12
    iterations: int = 40
    # [s] Torques that are predicted at most this time ahead include the estimated disturbance.
    disturbance_ahead: float = 0.3

    # Constants of the estimation of noise levels (`live.levels`).

    # [1] The logs are divided into `folds` folds, which are held out one at a time. A fit to the other folds needs at
    # least `min_samples` samples of motion, and uses at most `max_samples`.
    folds: int = 3
    min_samples: int = 300
    max_samples: int = 2**11
    # The grid for the estimation of `BlockNoise`: time constants of the disturbance [s], and standard deviations of the
    # disturbance divided by the standard deviation of white noise [1].
    time_constants: tuple[float, ...] = (0.1, 0.2, 0.4, 0.8, 1.6, 3.2, 6.4)
    disturbance_ratios: tuple[float, ...] = (0, 0.25, 0.5, 0.75, 1, 1.5, 2, 3, 5)
    # [1] Noise of the estimated payload is found by trials: estimates from segments of logs without payload
    # (`live.levels.load_variance`). Lengths of these segments, as numbers of blocks of the payload filter: 5 and 10 s.
    trial_blocks: tuple[int, ...] = (25, 50)
    # [1] Prior value of `NoiseLevels.load_variance`, with the weight of `prior_trials` trials: the logs of an arm often
    # have too few trials for an estimate.
    prior_variance: float = 2.25
    prior_trials: int = 4
    # [1] The noise variance of the momentum observer at the velocity qd is s^2 (1 + (r exp(-|qd| / v))^2). Grid of its
    # parameters (`live.levels`): velocity scales v divided by the largest speed, and ratios r between the additional
    # noise at rest and the noise s in motion.
    resting_speeds: tuple[float, ...] = (0.01, 0.02, 0.05, 0.1, 0.2)
    resting_ratios: tuple[float, ...] = (0, 1, 2, 4, 8, 16)

    # Constants of reports (`live.replay`).

    # [s] Contacts separated by less than this time are reported as one contact.
    merged: float = 0.2

    @property
    def evidence(self) -> float:
        """Constant terms of the log evidence of a payload, which depend neither on logs nor on the prior mean.

        They are the constants of Laplace's approximation and of the Wishart density of the pseudo-inertia J, with the
        determinant |dJ/dtheta| = 1/2 for the inertial parameters theta.
        """
        wishart = 2 * self.degrees * math.log(2) + float(multigammaln(self.degrees / 2, 4))
        return 5 * math.log(2 * math.pi) - math.log(2) - wishart


TUNING = LiveTuning()
