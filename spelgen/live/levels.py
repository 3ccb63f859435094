"""Estimation of the estimator's noise levels for a fit, by cross-validation on the training logs.

The noise is estimated from the torque residual on logs to which the model was not fitted: the residual on the logs to
which a model was fitted would be too small.
"""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from spelgen.dynamics.bristles import bristle_reach, encoder_step
from spelgen.dynamics.parameters import without_idle_residuals, without_residuals
from spelgen.dynamics.protocol import residual_terms
from spelgen.dynamics.tip_frame import load_frame
from spelgen.emission.assemble import assemble, spec_of
from spelgen.emission.specify import arm_of_spec
from spelgen.errors import LogError, RunError
from spelgen.fitting.fitted import Fit, required_spec
from spelgen.fitting.process import threads_of_torch
from spelgen.fitting.torque.fit import fit_torque
from spelgen.fitting.torque.samples import TorqueSamples
from spelgen.fitting.torque.tuning import TUNING as TORQUE
from spelgen.live.contact import ContactObserver
from spelgen.live.filters import Block, Blocks, JointFilters, LoadFilter
from spelgen.live.intake import Intake, balance_along
from spelgen.live.momentum import Balance
from spelgen.live.noise import BlockNoise, NoiseLevels, keep_levels, stored_levels
from spelgen.live.payload import NO_REPORT
from spelgen.live.tuning import TUNING
from spelgen.logs.dynamics_samples import dynamics_samples
from spelgen.logs.trajectory import Trajectory, joined_column
from spelgen.runtime.rigid_body_dynamics import RigidBodyDynamics

Folds = Sequence[tuple[RigidBodyDynamics, Sequence[Trajectory]]]
"""Pairs of a model and the logs to which it was not fitted."""


def noise_levels(fit: Fit) -> NoiseLevels:
    """Return the noise levels of a fit: stored in its run folder, or estimated from its logs and then stored.

    Raises RunError if stored levels cannot be read, or if there are neither stored levels nor logs.
    """
    levels = stored_levels(fit)
    if levels is None:
        if not fit.logs:
            raise RunError(
                "no noise levels of the estimator", file=fit.folder, expected="a run with estimator.json",
                do=f"fit it again by `spelgen train` to torques, with at least {TUNING.min_samples} samples of motion",
            )  # fmt: skip
        levels = cross_validated_levels(fit)
        keep_levels(fit, levels)
    return levels


# The number of torch's threads is 1 for all fits together. Otherwise each fit would raise it again at its end, and with
# torch 2.13 the factorisation of a batch of large matrices in the next fit would never end.
@threads_of_torch(1)
def cross_validated_levels(fit: Fit) -> NoiseLevels:
    """Return the noise levels of a fit, estimated by cross-validation on its logs.

    For each fold of the logs a model is fitted to the other folds, and the noise is estimated from the torque residual
    of the model on the held-out fold.
    """
    logs, count = list(fit.logs), TUNING.folds
    if len(logs) == 1:
        # A single log is divided into intervals, so that an interval can be held out.
        ends = np.linspace(0, len(logs[0]), count + 1).astype(int)
        logs = [logs[0][start:stop] for start, stop in itertools.pairwise(ends)]
    folds = [logs[k::count] for k in range(min(count, len(logs)))]
    effort, point = np.full(fit.model.n, np.inf), np.zeros(3)
    if fit.urdf is not None and fit.urdf.exists():
        arm = arm_of_spec(spec_of(fit.model), fit.urdf)
        effort = np.array([joint.effort or np.inf for joint in arm.chain.coordinates])
        # The contact force is estimated at a point of the last body: at the tip or, if the tip is fixed to another
        # body, at the origin of the last body.
        point = load_frame(arm)[1][:3, 3]
    others = [list(itertools.chain(*folds[:k], *folds[k + 1 :])) for k in range(len(folds))]
    tested = [(fitted_to(fit, training), fold) for training, fold in zip(others, folds, strict=True)]
    levels = find_levels(tested, effort, point, fit.preprocessing.torque_delay or 0.0)
    # Serialization rounds the noise levels. The rounded levels are returned, so that they are equal to the levels that
    # are later read from the run folder.
    return NoiseLevels.model_validate(levels.model_dump(mode="json"))


def fitted_to(fit: Fit, logs: Sequence[Trajectory]) -> RigidBodyDynamics:
    """Return a new model with the specification of a fit's model, fitted to ``logs``, for tests on held-out logs.

    At most ``TUNING.max_samples`` samples of the logs are used, which suffice for estimates of noise. Residual terms
    are selected only if the model of the fit has residual terms. Raises LogError if the logs have too little motion.
    """
    model = assemble(required_spec(fit.model)).double()
    if residual_terms(without_idle_residuals(fit.model)) is None:
        model = without_residuals(model)
    samples = dynamics_samples(logs, preprocessing=fit.preprocessing, reach=bristle_reach(model))
    samples = [x for x in samples if len(x.q)]
    if sum(len(x.q) for x in samples) < TUNING.min_samples:
        raise LogError(
            "too little motion to find noise levels of the estimator",
            expected=f"{TUNING.min_samples} samples that move in two thirds of the logs", do="record longer",
        )  # fmt: skip
    fit_torque(model, TorqueSamples.of(samples, TORQUE.decimation).subsampled(TUNING.max_samples))
    fitted = model.requires_grad_(False).eval()
    assert isinstance(fitted, RigidBodyDynamics)
    return fitted


class HeldOutSample(NamedTuple):
    """A sample of a held-out log, with the terms of the momentum balance of a model that was not fitted to the log.

    Attributes:
        t: time [s].
        at: terms of the momentum balance.
        is_resumed: True if the sample is the first one after a gap.
        block: means over the block of samples that ends at this sample; None if no block ends.
    """

    t: float
    at: Balance
    is_resumed: bool
    block: Block | None


def held_out(model: RigidBodyDynamics, log: Trajectory, levels: NoiseLevels) -> list[HeldOutSample]:
    """Return the accepted samples of a held-out log, with the terms of the momentum balance of ``model``.

    Samples are accepted or refused by the limits in ``levels`` (see `Intake`); its noise values are not used.
    """
    intake, blocks = Intake(levels, bristle_reach(model)), Blocks(levels.rest_speed)
    refusals, terms = balance_along(model, levels, intake, log.t, (log.q, log.qd, log.tau))
    samples = []
    for t, refusal, at in zip(log.t.tolist(), refusals, terms, strict=True):
        if at is not None:
            if refusal == "gap":
                blocks.restart()
            samples.append(HeldOutSample(t, at, refusal == "gap", blocks.add(t, at)))
    return samples


def find_levels(folds: Folds, effort: np.ndarray, point: np.ndarray, delay: float) -> NoiseLevels:
    """Return the noise levels of an arm, estimated from held-out logs.

    Args:
        folds: pairs of a model and its held-out logs, to which it was not fitted.
        effort: torque limits, (n,) [Nm, N]; infinite if unknown.
        point: position of the tip in the frame of the last body, (3,) [m].
        delay: delay of the torques relative to the positions [s].
    """
    logs = [log for _, fold in folds for log in fold]
    largest = np.abs(joined_column(logs, "tau")).max(axis=0)
    # At first `levels` contains only the limits by which samples are accepted; the noise is then estimated from the
    # accepted samples. `limit` is the torque limit of the URDF, but at least 1.2 times the largest logged torque. If
    # logged torques exceed the limit of the URDF by more than 20 %, or if it is absent or a placeholder, `limit` is a
    # guess: 2.5 times the largest logged torque. A placeholder is at least 100 times the largest logged torque; real
    # limits are 1.3 to 50 times the largest torque of recordings. A payload may need more torque than the guess, so a
    # torque counts as saturated only if it is at least `TUNING.jump` times the guess.
    is_known = (1.2 * effort >= largest) & (effort < 100 * largest)
    limit = np.where(is_known, np.maximum(effort, 1.2 * largest), 2.5 * largest)
    encoder = np.min([encoder_step(log.q) for log in logs], axis=0)
    levels = NoiseLevels.model_construct(
        speed=np.abs(joined_column(logs, "qd")).max(axis=0), encoder=encoder, effort=limit, point=point, delay=delay,
        minutes=sum(log.duration for log in logs) / 60, saturation=np.where(is_known, 1.0, TUNING.jump),
    )  # fmt: skip
    tested = [held_out(model, log, levels) for model, fold in folds for log in fold]
    segments = [[x.block for x in samples if x.block is not None] for samples in tested]
    # A block of the payload filter is joined from two blocks of the drift filter. This halves the number of updates of
    # the payload filter, which take longer since it has 10 + 3 n states.
    pairs = [[a.joined(b) for a, b in zip(x[::2], x[1::2], strict=False)] for x in segments]
    levels = levels.model_copy(update={"drift": block_noise(segments), "load": block_noise(pairs)})
    payload = load_variance(list(itertools.chain(*pairs)), levels)
    return _with_observer(levels.model_copy(update=payload), tested)


def load_variance(blocks: Sequence[Block], levels: NoiseLevels) -> dict[str, float]:
    """Return the fields `load_variance`, a factor for the covariance of estimated payloads, and `load_freedom`.

    The covariance P of the payload filter neglects errors of the model, and is therefore multiplied by the factor. The
    factor is found by trials on logs without payload:

    1. A trial estimates the payload from several consecutive blocks. The true payload is zero, so the estimate x is an
       error. Its normalised square is s = x^T P^-1 x / k, for the mass (k = 1) and for mass and first moments (k = 4).
    2. The mean of s over all trials is computed for each k, and for trials of each of the lengths `trial_blocks`: since
       errors are correlated over time, the mean depends on the length. As a prior, `prior_trials` trials with
       s = `prior_variance` are added to the trials of each mean.
    3. The factor is the largest mean. Its degrees of freedom are the number of trials in this mean, prior included.

    Args:
        blocks: consecutive blocks of the payload filter, from held-out logs.
        levels: noise levels, with the noise of the payload filter.
    """
    factors = []
    for window in TUNING.trial_blocks:
        squares = np.zeros(2)
        trials = len(blocks) // window
        for start in range(0, trials * window, window):
            load = LoadFilter(levels.load, levels.effort)
            for block in blocks[start : start + window]:
                load.predict(block.duration)
                for joint in range(load.n):
                    load.update(block, joint)
            squares += [load.x[:k] @ np.linalg.solve(load.P[:k, :k], load.x[:k]) / k for k in (1, 4)]
        freedom = trials + TUNING.prior_trials
        prior = TUNING.prior_trials * TUNING.prior_variance
        factors.append((float(squares.max() + prior) / freedom, freedom))
    return dict(zip(("load_variance", "load_freedom"), max(factors), strict=True))


def block_noise(segments: Sequence[Sequence[Block]]) -> BlockNoise:
    """Return the maximum-likelihood noise of the momentum balance for each joint.

    The model is y = f a + b + d + w per joint, with torque residual y, friction torque f, friction change a, offset b,
    disturbance d (an Ornstein-Uhlenbeck process) and white noise w (see `live.filters`). The likelihood is maximized
    over a grid of time constants of d, and of ratios between the standard deviations of d and w. The standard deviation
    of w is estimated for each grid point.

    segments: consecutive blocks of each log.
    """
    grid = np.array(list(itertools.product(TUNING.time_constants, TUNING.disturbance_ratios)))
    typical = np.median(np.abs([x.y for blocks in segments for x in blocks]), axis=0) + 1e-9
    scale = np.tile(typical, (len(grid), 1))
    for _ in range(3):
        _cost, squares = _likelihood(segments, grid, scale)
        scale = scale * np.sqrt(squares)
    best = _likelihood(segments, grid, scale)[0].argmin(axis=0)
    white = scale[best, np.arange(len(best))]
    return BlockNoise(white=white, disturbance=white * grid[best, 1], time_constant=grid[best, 0])


def _likelihood(
    segments: Sequence[Sequence[Block]], grid: np.ndarray, scale: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the negative log likelihood of the torque residuals, (G, n), for G noise models per joint.

    `JointFilters` predicts the residual of each block. The second result is the mean of the squared prediction error
    divided by its variance, (G, n), from which the scale of the noise is corrected.

    Args:
        segments: consecutive blocks of each log.
        grid: time constant of the disturbance d [s], and ratio of the standard deviations of d and of the white noise w
            [1], (G, 2).
        scale: standard deviations of the white noise w, (G, n) [Nm, N].
    """
    constant, ratio = grid.T[:, :, None]
    cost, squares, count = np.zeros((3, *scale.shape))
    # `prior`, (G, n, 3): prior standard deviations of the friction change a [1], the offset b [Nm, N] and the
    # disturbance d [Nm, N] for each of the G noise models. The prior of the offset is 4 standard deviations of the
    # white noise.
    prior = np.stack([np.full_like(scale, TUNING.friction), 4 * scale, scale * ratio], axis=-1)
    for blocks in segments:
        # The option `drifts` of the filters is False by default: samples of joints at rest then change no state. Here
        # only the noise of joints in motion is estimated.
        filters = JointFilters(prior, scale, constant)
        for block in blocks:
            residual, expected = filters.update(block, block.y)
            squared = np.minimum(np.square(residual) / expected, TUNING.outlier**2)
            cost += 0.5 * (np.log(expected) + squared) * block.moving
            squares += squared * block.moving
            count += block.moving
    return cost, squares / np.maximum(count, 1)


def _with_observer(levels: NoiseLevels, tested: Sequence[Sequence[HeldOutSample]]) -> NoiseLevels:
    """Return ``levels`` with the fields that determine the contact thresholds (see `NoiseLevels`).

    They are the noise of the momentum observer in motion and at rest (`observer`, `resting`, `resting_speed`), and the
    distribution of the largest values of its residual (`peak_start`, `peak_scale`, `peak_count`).

    levels: noise levels without these fields. tested: held-out samples of each log.
    """
    zeros, ones = np.zeros_like(levels.speed), np.ones_like(levels.speed)
    # The logs have no contacts: with infinite thresholds the observer detects none.
    no_contact = {
        "observer": ones, "resting": zeros, "resting_speed": ones, "peak_start": np.full_like(ones, np.inf),
        "peak_scale": zeros, "peak_count": 1.0,
    }  # fmt: skip
    levels = levels.model_copy(update=no_contact)
    signal = np.concatenate([_observed(levels, samples)[0] for samples in tested])
    qd = np.array([sample.at.velocity for samples in tested for sample in samples])
    levels = levels.model_copy(update=_observer_noise(signal, qd, levels))
    peaks = []
    for samples in tested:
        # Large residuals at neighbouring samples are one event, so a peak is the largest value in a time window.
        starts = np.flatnonzero(np.diff([sample.t // TUNING.window for sample in samples], prepend=np.nan))
        peaks.append(np.maximum.reduceat(_observed(levels, samples)[1], starts, axis=0))
    return levels.model_copy(update=held_out_tail(peaks, levels))


def _observed(levels: NoiseLevels, samples: Sequence[HeldOutSample]) -> np.ndarray:
    """Apply the momentum observer to T held-out samples.

    Returns the external torques [Nm, N] and `ContactObserver.normalised` [1], stacked, (2, T, n).
    """
    observer, drift = ContactObserver(levels, TUNING.alarms_per_minute), JointFilters.of_drift(levels.drift)
    rows = []
    for t, at, is_resumed, block in samples:
        if is_resumed:
            observer.restart()
        rows.append((observer.step(t, at, NO_REPORT, drift.x).external_torque, observer.normalised))
        if block is not None:
            observer.end_block()
            drift.update(block, block.y)
    return np.array(rows).swapaxes(0, 1)


def held_out_tail(peaks: Sequence[np.ndarray], levels: NoiseLevels) -> dict[str, object]:
    """Return the distribution of the largest peaks: `peak_start`, `peak_scale` and `peak_count` of `NoiseLevels`.

    A peak is the largest residual of the momentum observer in a time window, divided by its standard deviation. An
    exponential distribution fitted to the largest peaks gives the contact thresholds. Thresholds from some logs cause
    too many alarms on other logs, since peaks differ between logs. All peaks, and thereby the thresholds, are therefore
    multiplied by a factor, which is found by cross-validation:

    1. For each log, thresholds are computed from the peaks of all other logs. A time window of the log has an alarm if
       the peak of a joint exceeds its threshold times the factor.
    2. The factor is the smallest one with which the windows of all logs have no more alarms than the default rate of
       false alarms allows, and at least `TUNING.other_days`.

    All joints have the same factor. Factors of single joints would be too small for new logs, since the joint with the
    largest ratio of peak to threshold differs from log to log.

    Args:
        peaks: peaks of each log in W time windows, (W, n) [1].
        levels: noise levels, with the noise of the observer.
    """
    excess = []
    for k, peaks_of_log in enumerate(peaks):
        others = levels.model_copy(update=_peak_tail([*peaks[:k], *peaks[k + 1 :]]))
        excess += (peaks_of_log / others.thresholds(TUNING.alarms_per_minute)).max(axis=1).tolist()
    allowed = int(TUNING.alarms_per_minute * len(excess) * TUNING.window / 60)
    return _peak_tail(peaks, max(sorted(excess, reverse=True)[allowed], TUNING.other_days))


def _peak_tail(peaks: Sequence[np.ndarray], factor: float = 1.0) -> dict[str, object]:
    """Fit an exponential distribution to the largest peaks; return its start, scale and number of peaks.

    The keys are the fields `peak_start`, `peak_scale` and `peak_count` of `NoiseLevels`.

    peaks: largest normalised residuals of each log in W time windows, (W, n) [1]; they are multiplied by `factor`.
    """
    together = factor * np.concatenate(peaks)
    start = np.quantile(together, 1 - TUNING.tail, axis=0)
    # `start` is the same quantile for each joint, so the number of peaks above it is the same for all joints, except
    # for joints whose residuals are all zero.
    count = max(int((together > start).sum(axis=0).max()), 1)
    scale = np.maximum(together - start, 0).sum(axis=0) / count
    # `scale` (n,) is the mean excess over `start` of the `count` largest peaks of each joint. The scales of the joints
    # are similar, but each has a relative standard error of 1 / sqrt(count). To reduce the errors, the scales are
    # shrunk towards their mean (James and Stein, 1961). The weight w of the mean is the error variance divided by the
    # variance of the scales over the joints. A shrunk scale is as exact as one from `peak_count` = count / (1 - w)
    # peaks. All n joints together have only n count peaks, so w is at most 1 - 1 / n.
    n, mean = len(scale), scale.mean()
    variance = max(float(scale.var(ddof=min(n - 1, 1))), 1e-300)
    weight = min(mean**2 / count / variance, 1 - 1 / n)
    scale += weight * (mean - scale)
    return {"peak_start": start, "peak_scale": scale, "peak_count": count / (1 - weight)}


def _observer_noise(signal: np.ndarray, qd: np.ndarray, levels: NoiseLevels) -> dict[str, np.ndarray]:
    """Return the noise of the momentum observer in motion and at rest, as {field of `NoiseLevels`: value}.

    The noise variance of a joint at the velocity qd is s^2 (1 + (r exp(-|qd| / v))^2). The likelihood is maximized over
    a grid of the ratio r and the velocity scale v of the additional noise near standstill; the noise s in motion is
    estimated for each grid point.

    Args:
        signal: external torques of logs without contacts, (T, n) [Nm, N].
        qd: velocities, (T, n) [rad/s, m/s].
        levels: the values of v on the grid are fractions of `speed`, the largest speeds; s has a lower bound
            proportional to `effort`, the torque limits.
    """
    grid = np.array(list(itertools.product(TUNING.resting_speeds, TUNING.resting_ratios)))
    noise, costs = np.zeros((2, len(grid), len(levels.speed)))
    for k, (speed, ratio) in enumerate(grid):
        shape = 1 + np.square(ratio * np.exp(-np.abs(qd) / (speed * levels.speed)))
        # The noise variance is estimated by the median of the squares, on which peaks have no influence: peaks are
        # modelled separately. 0.455 is the median of the square of a standard normal variable.
        level = np.sqrt(np.median(signal**2 / shape, axis=0) / 0.455)
        noise[k] = np.maximum(level, TUNING.min_observer_noise * levels.effort)
        normalised = np.abs(signal) / (noise[k] * np.sqrt(shape))
        # Huber's cost is quadratic for normalised residuals up to TUNING.outlier, and linear above.
        inner = np.minimum(normalised, TUNING.outlier)
        costs[k] = np.mean(np.log(noise[k] ** 2 * shape) + inner * (2 * normalised - inner), axis=0)
    best = costs.argmin(axis=0)
    observer, (speed, ratio) = noise[best, np.arange(len(best))], grid[best].T
    resting = TUNING.outlier * ratio * observer
    return {"observer": observer, "resting": resting, "resting_speed": speed * levels.speed}
