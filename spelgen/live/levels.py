"""Noise levels from the training logs of a fit, by cross-validation over logs."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from spelgen.dynamics.bristles import bristle_reach, encoder_step
from spelgen.live.blocks import Block, Blocks, joined
from spelgen.live.contact import ContactObserver
from spelgen.live.filters import DriftFilter, LoadFilter
from spelgen.live.intake import IGNORED, Intake
from spelgen.live.momentum import Balance, balance
from spelgen.live.noise import TAIL, BlockNoise, NoiseLevels
from spelgen.live.payload import NO_REPORT
from spelgen.live.tuning import TUNING
from spelgen.logs.trajectory import Trajectory, joined_column
from spelgen.runtime.rigid_body_dynamics import RigidBodyDynamics

_TIME_CONSTANTS = np.geomspace(0.1, 6.4, 7)  # [s] time constants of the disturbance
# [1] standard deviation of the disturbance divided by the one of white noise
_RATIOS = np.array([0, 0.25, 0.5, 0.75, 1, 1.5, 2, 3, 5])

WINDOWS = (25, 50)  # lengths of the trials of the payload filter, in blocks: 5 and 10 s


@dataclass(frozen=True, eq=False)
class HeldOut:
    """A held-out log, its used samples, and the terms of the momentum balance of a model that was not fitted to it."""

    log: Trajectory
    used: list[int]
    terms: Balance


def held_out(model: RigidBodyDynamics, log: Trajectory, levels: NoiseLevels) -> HeldOut:
    """Return the terms of the momentum balance of a model at the accepted samples of a log."""
    intake = Intake(levels, bristle_reach(model))
    used: list[int] = []
    low, high = [], []
    for k, sample in enumerate(zip(log.t.tolist(), log.q, log.qd, log.tau, strict=True)):
        if intake.accept(*sample) not in IGNORED:
            used.append(k)
            low.append(intake.low)
            high.append(intake.high)
    samples = [x[used] for x in (log.q, log.qd, log.tau)]
    return HeldOut(log, used, balance(model, levels.point, samples, (np.array(low), np.array(high))))


def find_levels(
    folds: Sequence[tuple[RigidBodyDynamics, Sequence[Trajectory]]], effort: np.ndarray, point: np.ndarray
) -> NoiseLevels:
    """Return the noise levels of an arm from held-out logs.

    Args:
        folds: models, each with the logs that it was not fitted to.
        effort: limits of the torque, (n,) [Nm, N]; infinite if unknown.
        point: the tip in the frame of the last body, (3,) [m].
    """
    logs = [log for _, fold in folds for log in fold]
    n = len(effort)
    largest = np.abs(joined_column(logs, "tau")).max(axis=0)
    unknown = BlockNoise(white=np.ones(n), disturbance=np.ones(n), time_constant=np.ones(n))
    levels = NoiseLevels(
        drift=unknown,
        load=unknown,
        observer=np.ones(n),
        peak_start=np.ones(n),
        peak_scale=np.ones(n),
        load_variance=TUNING.variance,
        coulomb=np.mean([model.coulomb.numpy() for model, _ in folds], axis=0),
        speed=np.abs(joined_column(logs, "qd")).max(axis=0),
        encoder=np.min([encoder_step(log.q) for log in logs], axis=0),
        # no limit is below the largest logged torque
        effort=np.maximum(np.where(np.isfinite(effort), effort, 2.5 * largest), 1.2 * largest),
        minutes=sum(log.duration for log in logs) / 60,
        point=point,
    )
    tested = [held_out(model, log, levels) for model, fold in folds for log in fold]
    segments = [blocks_along(each, levels) for each in tested]
    pairs = [list(itertools.starmap(joined, zip(x[::2], x[1::2], strict=False))) for x in segments]
    levels = levels.model_copy(update={"drift": block_noise(segments), "load": block_noise(pairs)})
    levels = levels.model_copy(update={"load_variance": load_variance(pairs, levels)})
    return _with_observer(levels, tested)


def load_variance(segments: Sequence[Sequence[Block]], levels: NoiseLevels) -> float:
    """Return the factor on the covariance of estimated payloads, from logs without payload: each estimate is an error.

    Windows of blocks are independent trials. The factor is the mean squared normalised estimate of mass and first
    moments, (4,), the larger one of two lengths of windows: errors of the model average out slowly.
    """
    factors = [TUNING.variance]
    for window in WINDOWS:
        squares: list[float] = []
        for blocks in segments:
            for start in range(0, len(blocks) - window + 1, window):
                load = LoadFilter(levels.load, levels.effort)
                for block in blocks[start : start + window]:
                    load.predict(block.duration)
                    for joint in range(load.n):
                        load.update(block, joint)
                squares.append(float(load.x[:4] @ np.linalg.solve(load.P[:4, :4], load.x[:4])) / 4)
        if squares:
            factors.append(float(np.mean(squares)))
    return max(factors)


def blocks_along(tested: HeldOut, levels: NoiseLevels) -> list[Block]:
    """Return the consecutive blocks of a held-out log."""
    sums, blocks = Blocks(len(levels.speed), levels.rest_speed), []
    before = -np.inf
    for k, row in zip(tested.used, zip(*tested.terms, strict=True), strict=True):
        t = float(tested.log.t[k])
        if t - before > TUNING.gap:
            sums.restart()
        before = t
        block = sums.add(t, tested.log.qd[k], Balance(*row))
        if block is not None:
            blocks.append(block)
    return blocks


def block_noise(segments: Sequence[Sequence[Block]]) -> BlockNoise:
    """Return the noise of maximum likelihood over a grid, per joint; segments: consecutive blocks, for each log.

    The model is y = f a + b + d + w per joint (see `live.filters`); white noise has its own scale for each point of
    the grid.
    """
    grid = np.array(list(itertools.product(_TIME_CONSTANTS, _RATIOS)))
    n = len(segments[0][0].y)
    scale = np.full(
        (len(grid), n), np.median(np.abs([x.y for blocks in segments for x in blocks]), axis=0) + 1e-9
    )
    for _ in range(3):
        _cost, squares = _likelihood(segments, grid, scale)
        scale = scale * np.sqrt(squares)
    best = _likelihood(segments, grid, scale)[0].argmin(axis=0)
    white = scale[best, np.arange(n)]
    return BlockNoise(white=white, disturbance=white * grid[best, 1], time_constant=grid[best, 0])


def _likelihood(
    segments: Sequence[Sequence[Block]], grid: np.ndarray, scale: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the negative log likelihood and the mean normalised squared residual, (grid, n).

    Args:
        segments: consecutive blocks, for each log.
        grid: time constants and ratios, (grid, 2).
        scale: standard deviations of white noise, (grid, n).
    """
    constant, ratio = grid.T[:, :, None]
    cost, squares, count = np.zeros((3, *scale.shape))
    disturbance = np.square(scale * ratio)
    for blocks in segments:
        x = np.zeros((*scale.shape, 3))
        P = np.zeros((*scale.shape, 3, 3))
        P[..., 0, 0] = TUNING.friction**2
        P[..., 1, 1] = np.square(4 * scale)
        P[..., 2, 2] = disturbance
        for block in blocks:
            decay = np.ones_like(x)
            decay[..., 2] = np.exp(-block.duration / constant)
            x *= decay
            P *= decay[..., None] * decay[..., None, :]
            P[..., 2, 2] += (1 - decay[..., 2] ** 2) * disturbance
            row = np.ones(x.shape)
            row[..., 0] = block.friction
            covariance = (P @ row[..., None])[..., 0]
            expected = (row * covariance).sum(axis=-1) + np.square(scale)
            expected = expected + TUNING.uncertainty * np.square(block.uncertainty)
            residual = block.y - (row * x).sum(axis=-1)
            squared = np.minimum(np.square(residual) / expected, TUNING.outlier**2)
            gain = covariance / np.maximum(expected, np.square(residual) / TUNING.outlier**2)[..., None]
            # the noise of motion is estimated from moving joints only
            gain = gain * block.moving[:, None]
            cost += 0.5 * (np.log(expected) + squared) * block.moving
            squares += squared * block.moving
            count += block.moving
            x += gain * residual[..., None]
            P -= gain[..., None] * covariance[..., None, :]
    return cost, squares / np.maximum(count, 1)


def _with_observer(levels: NoiseLevels, tested: Sequence[HeldOut]) -> NoiseLevels:
    """Return the levels completed by the noise of the momentum observer and the exponential tail of its peaks."""
    signals: list[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]] = []
    zero = levels.model_copy(update={"observer": np.zeros_like(levels.observer)})
    for each in tested:
        observer, drift = ContactObserver(zero, TUNING.alarms_per_minute), DriftFilter(levels.drift)
        sums = Blocks(len(levels.speed), levels.rest_speed)
        for k, row in zip(each.used, zip(*each.terms, strict=True), strict=True):
            t, qd, at = float(each.log.t[k]), each.log.qd[k], Balance(*row)
            if observer.t is not None and t - observer.t > TUNING.gap:
                observer.restart()
                sums.restart()
            signal, variance = observer.residual(t, qd, at, NO_REPORT, drift.a)
            signals.append((np.array(t), signal, variance, np.abs(qd) > levels.rest_speed))
            block = sums.add(t, qd, at)
            if block is not None:
                drift.update(block, NO_REPORT.parameters)
    times, signal, variance, moving = (np.array(column) for column in zip(*signals, strict=True))
    # of a moving joint: 0.455 is the median of the squared standard normal distribution
    squares = np.nanmedian(np.where(moving, np.square(signal), np.nan), axis=0) / 0.455
    observer_level = np.maximum(np.sqrt(squares), TUNING.min_observer_noise * levels.effort)
    ratio = np.abs(signal) / np.sqrt(variance + observer_level**2)
    window = np.concatenate([[0], np.cumsum(np.abs(np.diff(times // TUNING.window)) > 0)])
    starts = np.flatnonzero(np.diff(window, prepend=-1))
    peaks = np.maximum.reduceat(ratio, starts, axis=0)
    start = np.quantile(peaks, 1 - TAIL, axis=0)
    tail = np.where(peaks > start, peaks - start, np.nan)
    update = {"observer": observer_level, "peak_start": start, "peak_scale": np.nanmean(tail, axis=0)}
    return levels.model_copy(update=update)
