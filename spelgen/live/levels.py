"""Noise levels of a fit, which are read from the run folder or estimated by cross-validation on the training logs.

The noise is estimated from the torque residual of a model that was fitted to other logs: the residual of the logs to
which a model was fitted would be too small.
"""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from spelgen.arm.configured_arm import Arm
from spelgen.baselines.registry import arm_of_model
from spelgen.dynamics.bristles import bristle_reach, encoder_step
from spelgen.dynamics.parameters import without_idle_residuals, without_residuals
from spelgen.dynamics.protocol import residual_terms
from spelgen.dynamics.tip_frame import tip_frame
from spelgen.emission.assemble import assemble
from spelgen.errors import LogError, RunError
from spelgen.files import read_json, write_json
from spelgen.fitting.fitted import Fit, required_spec
from spelgen.fitting.run_folder import RunFolder
from spelgen.fitting.run_record import require
from spelgen.fitting.torque.fit import fit_torque
from spelgen.fitting.torque.samples import TorqueSamples
from spelgen.fitting.torque.tuning import TUNING as TORQUE
from spelgen.live.contact import ContactObserver
from spelgen.live.filters import Block, Blocks, JointFilters, LoadFilter
from spelgen.live.intake import Intake, balance_along
from spelgen.live.momentum import Balance
from spelgen.live.noise import BlockNoise, NoiseLevels
from spelgen.live.payload import NO_REPORT
from spelgen.live.tuning import TUNING
from spelgen.logs.dynamics_samples import dynamics_samples
from spelgen.logs.trajectory import Trajectory, joined_column
from spelgen.runtime.rigid_body_dynamics import RigidBodyDynamics
from spelgen.settings.fits import TorqueFit


def noise_levels(fit: Fit) -> NoiseLevels:
    """Return the stored or estimated noise levels of a fit. Raises RunError if they cannot be read or estimated."""
    levels = stored_levels(fit)
    if levels is not None:
        return levels
    if not fit.logs:
        raise RunError(
            "no noise levels of the estimator", file=fit.folder, expected="a run with estimator.json",
            do=f"fit it again by `spelgen train` to torques, with at least {TUNING.min_samples} samples of motion",
        )  # fmt: skip
    levels = cross_validated_levels(fit)
    keep_levels(fit, levels)
    return levels


def keep_levels(fit: Fit, levels: NoiseLevels | None = None) -> None:
    """Write noise levels into the run folder of a fit; levels None: estimate them if the fit is to torques."""
    of_torques = isinstance(fit.config, TorqueFit) and isinstance(fit.model, RigidBodyDynamics)
    if levels is None and of_torques and fit.logs:
        levels = cross_validated_levels(fit)
    if levels is not None and fit.folder is not None:
        write_json(RunFolder(fit.folder).estimator, levels.model_dump(mode="json"))


def stored_levels(fit: Fit) -> NoiseLevels | None:
    """Return the noise levels in the run folder of a fit; None if there are none."""
    file = None if fit.folder is None else RunFolder(fit.folder).estimator
    if file is None or not file.exists():
        return None
    return require(NoiseLevels, read_json(file, RunError), file)


def cross_validated_levels(fit: Fit) -> NoiseLevels:
    """Return the noise levels by cross-validation: each fold of the logs is held out of a fit."""
    logs, count = list(fit.logs), TUNING.folds
    if len(logs) == 1:
        # A single log is divided into parts, so that a part can be held out.
        ends = np.linspace(0, len(logs[0]), count + 1).astype(int)
        logs = [logs[0][start:stop] for start, stop in itertools.pairwise(ends)]
    folds = [logs[k::count] for k in range(min(count, len(logs)))]
    effort, tip = np.full(fit.model.n, np.inf), np.zeros(3)
    if fit.urdf is not None and fit.urdf.exists():
        effort, tip = limits(arm_of_model(fit.model, fit.urdf))
    tested = []
    for k, fold in enumerate(folds):
        others = [log for other in folds[:k] + folds[k + 1 :] for log in other]
        tested.append((fitted_to(fit, others), fold))
    levels = find_levels(tested, effort, tip)
    # Serialization rounds the numbers. The rounded numbers are returned, so that a later read of the run folder gives
    # the same ones.
    return NoiseLevels.model_validate(levels.model_dump(mode="json"))


def fitted_to(fit: Fit, logs: Sequence[Trajectory]) -> RigidBodyDynamics:
    """Return a new model of the same kind as the model of a fit, fitted to other logs from the initial parameters.

    A subset of the samples suffices to estimate the error on further logs. If the fit has no residual terms, none are
    selected here. Raises LogError for too little motion.
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


def limits(arm: Arm) -> tuple[np.ndarray, np.ndarray]:
    """Return the torque limits of an arm, (n,) [Nm, N], infinite if unknown, and the position of the tip, (3,) [m].

    The position is in the frame of the last body; it is zero if another body carries the tip.
    """
    effort = np.array([joint.effort or np.inf for joint in arm.chain.coordinates])
    tip = tip_frame(arm)
    is_last = tip.carrier == len(arm.chain.bodies) - 1
    return effort, tip.pose[:3, 3] if is_last else np.zeros(3)


class HeldOutSample(NamedTuple):
    """A sample of a log, with the terms of a model that was not fitted to the log; vectors are (n,).

    t: time [s]. at: terms of the momentum balance. is_resumed: whether the sample is the first one after a gap. block:
    the block that ends at this sample, or None.
    """

    t: float
    qd: np.ndarray
    at: Balance
    is_resumed: bool
    block: Block | None


def held_out(model: RigidBodyDynamics, log: Trajectory, levels: NoiseLevels) -> list[HeldOutSample]:
    """Return the accepted samples of a log, with the terms of the momentum balance."""
    intake, blocks = Intake(levels, bristle_reach(model)), Blocks(levels.rest_speed)
    refusals, terms = balance_along(model, levels, intake, log.t, (log.q, log.qd, log.tau))
    samples = []
    for t, qd, refusal, at in zip(log.t.tolist(), log.qd, refusals, terms, strict=True):
        if at is None:
            continue
        if refusal == "gap":
            blocks.restart()
        samples.append(HeldOutSample(t, qd, at, refusal == "gap", blocks.add(t, qd, at)))
    return samples


def find_levels(
    folds: Sequence[tuple[RigidBodyDynamics, Sequence[Trajectory]]], effort: np.ndarray, point: np.ndarray
) -> NoiseLevels:
    """Return the noise levels of an arm from held-out logs.

    Args:
        folds: models, each with the held-out logs, to which the model was not fitted.
        effort: torque limits, (n,) [Nm, N]; infinite if unknown.
        point: position of the tip in the frame of the last body, (3,) [m].
    """
    logs = [log for _, fold in folds for log in fold]
    largest = np.abs(joined_column(logs, "tau")).max(axis=0)
    # These `NoiseLevels` have limits and no noise values: the samples from which the noise is estimated depend on the
    # limits.
    levels = NoiseLevels.model_construct(
        speed=np.abs(joined_column(logs, "qd")).max(axis=0),
        encoder=np.min([encoder_step(log.q) for log in logs], axis=0),
        # A limit below the largest logged torque would be wrong.
        effort=np.maximum(np.where(np.isfinite(effort), effort, 2.5 * largest), 1.2 * largest),
        minutes=sum(log.duration for log in logs) / 60,
        point=point,
    )
    tested = [held_out(model, log, levels) for model, fold in folds for log in fold]
    segments = [[x.block for x in samples if x.block is not None] for samples in tested]
    pairs = [[a.joined(b) for a, b in zip(x[::2], x[1::2], strict=False)] for x in segments]
    levels = levels.model_copy(update={"drift": block_noise(segments), "load": block_noise(pairs)})
    factor, freedom = load_variance(list(itertools.chain(*pairs)), levels)
    levels = levels.model_copy(update={"load_variance": factor, "load_freedom": freedom})
    return _with_observer(levels, tested)


def load_variance(blocks: Sequence[Block], levels: NoiseLevels) -> tuple[float, int]:
    """Return the factor on the covariance of estimated payloads, and its degrees of freedom.

    The logs are without payload, so each estimated payload is an error. Windows of consecutive blocks are independent
    trials. Each trial has two normalised squared errors: of the mass, and of the mass and first moments. Each error is
    averaged over the trials; the prior value counts as `prior_trials` more trials. The factor is the largest average
    over both errors and all window lengths: errors of the model average out slowly, so that longer windows may have
    larger normalised errors.
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
            theta, covariance = load.x[:4], load.P[:4, :4]
            squares += (
                theta[0] ** 2 / covariance[0, 0],
                theta @ np.linalg.solve(covariance, theta) / len(theta),
            )
        freedom = trials + TUNING.prior_trials
        prior = TUNING.prior_trials * TUNING.prior_variance
        factors.append((float(squares.max() + prior) / freedom, freedom))
    return max(factors)


def block_noise(segments: Sequence[Sequence[Block]]) -> BlockNoise:
    """Return the maximum-likelihood noise of each joint, over a grid; segments: consecutive blocks of each log.

    The model is y = f a + b + d + w per joint (see `live.filters`). The grid has the time constant of d, and the ratio
    of the standard deviations of d and w. The scale of w is estimated for each point of the grid.
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
    """Return the negative log likelihood and the mean normalised squared residual, (G, n) each.

    Args:
        segments: consecutive blocks of each log.
        grid: time constant of d [s], and ratio of the standard deviations of d and w, at each of G points, (G, 2).
        scale: standard deviations of white noise, (G, n) [Nm, N].
    """
    constant, ratio = grid.T[:, :, None]
    cost, squares, count = np.zeros((3, *scale.shape))
    # prior standard deviations of a, b and d; the offset b is within a few standard deviations of white noise
    prior = np.stack([np.full_like(scale, TUNING.friction), 4 * scale, scale * ratio], axis=-1)
    for blocks in segments:
        # Without drift, joints at rest do not update the filters: the noise in motion is estimated.
        filters = JointFilters(prior, scale, constant)
        for block in blocks:
            residual, expected = filters.update(block, block.y)
            squared = np.minimum(np.square(residual) / expected, TUNING.outlier**2)
            cost += 0.5 * (np.log(expected) + squared) * block.moving
            squares += squared * block.moving
            count += block.moving
    return cost, squares / np.maximum(count, 1)


def _with_observer(levels: NoiseLevels, tested: Sequence[Sequence[HeldOutSample]]) -> NoiseLevels:
    """Return the levels with the noise of the momentum observer and the exponential tail of its peaks added."""
    columns: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    times = np.array([sample.t for samples in tested for sample in samples])
    for samples in tested:
        observer, drift = (
            ContactObserver(levels, TUNING.alarms_per_minute),
            JointFilters.of_drift(levels.drift),
        )
        for t, qd, at, is_resumed, block in samples:
            if is_resumed:
                observer.restart()
            columns.append((*observer.residual(t, at, NO_REPORT, drift.x), qd))
            if block is not None:
                drift.update(block, block.y)
    signal, variance, qd = (np.array(column) for column in zip(*columns, strict=True))
    levels = levels.model_copy(update=_observer_noise(signal, qd, levels))
    beyond = np.maximum(np.abs(signal) - levels.resting_torque(qd), 0)
    ratio = beyond / np.sqrt(variance + np.square(levels.observer))
    # Large values at neighbouring samples are one event, so only the largest value of each time window counts.
    starts = np.flatnonzero(np.diff(times // TUNING.window, prepend=np.nan))
    peaks = np.maximum.reduceat(ratio, starts, axis=0)
    start = np.quantile(peaks, 1 - TUNING.tail, axis=0)
    tail = np.where(peaks > start, peaks - start, np.nan)
    return levels.model_copy(update={"peak_start": start, "peak_scale": np.nanmean(tail, axis=0)})


def _observer_noise(signal: np.ndarray, qd: np.ndarray, levels: NoiseLevels) -> dict[str, np.ndarray]:
    """Return the maximum-likelihood noise of the observer in motion and at rest, over a grid.

    signal: torque residual of the observer, (T, n) [Nm, N]. qd: velocities, (T, n).
    """
    best: dict[str, np.ndarray] = {}
    lowest = np.full(len(levels.speed), np.inf)
    for speed, ratio in itertools.product(TUNING.resting_speeds, TUNING.resting_ratios):
        shape = 1 + np.square(ratio * np.exp(-np.abs(qd) / (speed * levels.speed)))
        # The median is used because peaks are modelled separately; 0.455 is the median of a squared standard normal
        # variable.
        level = np.sqrt(np.median(signal**2 / shape, axis=0) / 0.455)
        level = np.maximum(level, TUNING.min_observer_noise * levels.effort)
        normalised = np.abs(signal) / (level * np.sqrt(shape))
        # Huber's cost is quadratic for residuals up to TUNING.outlier, and linear beyond.
        inner = np.minimum(normalised, TUNING.outlier)
        cost = np.mean(np.log(level**2 * shape) + inner * (2 * normalised - inner), axis=0)
        found = {
            "observer": level,
            "resting": TUNING.outlier * ratio * level,
            "resting_speed": speed * levels.speed,
        }
        best = {key: np.where(cost < lowest, x, best.get(key, x)) for key, x in found.items()}
        lowest = np.minimum(cost, lowest)
    return best
