"""Motion that goes on as it did in training, without dynamics: what forecasts start from, and what they must beat.

A constant velocity, and parts of what a constant velocity and a constant acceleration (the mean one of the past) would
change: positions by v t and a t^2 / 2, velocities by v and a t. The parts are found for each joint and time ahead by
regression on windows of the training logs. Its errors have Student's t distribution, so that a few jumps do not decide
(Lange, Little and Taylor, J. Am. Stat. Assoc. 84:881, 1989).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spelgen.evaluation.along_time import at_times, by_stretch, certain

FREEDOM = 3.0  # degrees of it that Student's distribution has
ROUNDS = 20  # of weighing windows
LEAST = 1e-12  # relative: columns that are smaller than rounding


@dataclass(frozen=True, eq=False)
class Extrapolation:
    """Parts (2, 2, T, n) at times (T,) [s]: of velocity and of acceleration, for q and for qd. past: [s]."""

    times: np.ndarray
    parts: np.ndarray
    past: float

    def added(self, qd: np.ndarray, change: np.ndarray, times: np.ndarray) -> np.ndarray:
        """What is added to a constant velocity at times (K,) [s]: (2, W, K, n), of q and qd.

        qd, change: (W, n) the velocity, and its change over the past.
        """
        columns = _columns(qd, change / self.past, times)
        added: np.ndarray = np.einsum("cskn,cswkn->swkn", at_times(self.parts, self.times, times), columns)
        return added


def extrapolation(
    qd: np.ndarray,
    change: np.ndarray,
    measured: np.ndarray,
    blocks: np.ndarray,
    times: np.ndarray,
    past: float,
) -> Extrapolation:
    """As windows of the training logs show it.

    qd, change: (W, n). measured: (2, W, T, n) how q and qd differ from a constant velocity's at times (T,) [s].
    blocks: (W,) stretches of time: parts are kept at times at which they predict those that they were not fitted to
    better than none do, surely so over all joints, and at a joint by itself. past: [s] over which the velocity changed.
    """
    columns = _columns(qd, change / past, times)
    everywhere = np.ones((1, len(blocks)))
    elsewhere = (blocks != np.arange(blocks.max() + 1)[:, None]).astype(float)  # (B, W)
    (parts,), (weights,) = _regressed(columns, measured, everywhere)
    others, _ = _regressed(columns, measured, elsewhere)
    left = measured - np.einsum("wcskn,cswkn->swkn", others[blocks], columns)
    before, after = (by_stretch(weights * np.square(x), blocks) for x in (measured, left))
    alone = before.sum(axis=0)
    gains = np.divide(before - after, alone, out=np.zeros_like(before), where=alone > 0)
    together = gains.sum(axis=-1, keepdims=True)
    chance = np.sqrt(len(together) * together.var(axis=0, ddof=1))
    better = (gains.sum(axis=0) > 0) & (together.sum(axis=0) > certain(len(together)) * chance)
    return Extrapolation(times, np.where(better, parts, 0.0), past)


def _columns(qd: np.ndarray, acceleration: np.ndarray, times: np.ndarray) -> np.ndarray:
    """(2, 2, W, K, n): what velocity and acceleration change of q and qd, but for the parts."""
    t, v, a = times[:, None], qd[:, None], acceleration[:, None]
    still = np.ones_like(t)
    return np.stack([np.stack([v * t, v * still]), np.stack([a * t**2 / 2, a * t])])


def _regressed(
    columns: np.ndarray, measured: np.ndarray, counted: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Parts (B, C, 2, T, n) by the windows that count, (B, W), and weights (B, 2, W, T, n) of the last round."""
    counted = counted[:, None, :, None, None]
    size = np.sqrt(np.square(columns).sum(axis=2, keepdims=True))
    unit = columns / np.where(size > 0, size, 1.0)
    ridge = LEAST * np.eye(len(columns))
    weights = counted * np.ones_like(measured)
    for _ in range(ROUNDS):
        products = np.einsum("cswkn,dswkn,bswkn->bskncd", unit, unit, weights)
        target = np.einsum("cswkn,swkn,bswkn->bsknc", unit, measured, weights)
        parts = np.linalg.solve(products + ridge, target[..., None])[..., 0]
        squares = np.square(measured - np.einsum("bsknc,cswkn->bswkn", parts, unit))
        variance = (weights * squares).sum(axis=2, keepdims=True) / counted.sum(axis=2, keepdims=True)
        ratio = np.divide(squares, variance, out=np.zeros_like(squares), where=variance > 0)
        weights = counted * (FREEDOM + 1) / (FREEDOM + ratio)
    return np.moveaxis(parts, -1, 1) / np.where(size > 0, size, 1.0)[None, :, :, 0], weights
