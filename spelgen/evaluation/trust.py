"""How far rollouts are to be followed from extrapolated motion, as windows of the training logs show it.

A forecast is a combination of forecasts (Bates and Granger, Oper. Res. Q. 20:451, 1969): extrapolated motion plus a
part of what a rollout adds to it. The parts are gains by joint and time ahead, of positions and velocities together: a
force that is missed moves both, so that each tells what the other errs. They are found by least squares, less one
standard error by the jackknife over stretches of time, since errors of windows that overlap are alike; they are 0
where windows that they were not fitted to are not predicted better by two standard errors. What a window's past lacks
may do more than it did in training: with another load, on another day, or where few logs were fitted too well. What is
missed then grows in proportion, and the part falls.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from spelgen.evaluation.along_time import CERTAIN, at_times, by_stretch, certain

TIMES = (0.01, 0.02, 0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.7, 1.0)  # s
SHORTEST = 0.05  # s: of the horizons that a model is said to be good for
CLEAR = 0.9  # of extrapolated motion's error, what a forecast's is at most where the model is good
LEAST_BLOCKS = 3
MIXTURES = np.linspace(0, 1, 9)  # parts of the rollout with the disturbance held; the rest is that without
FOLLOWED = 2.0  # times as far as a training window went: what is taken of a rollout, if it goes farther
LEAST = 1e-9  # relative: what keeps the equations solvable where rollouts are proportional or nothing
TINY, FARTHEST = 1e-300, 1e6


@dataclass(frozen=True, eq=False)
class Trust:
    """Of one predictor, at times (T,) [s], for q and qd.

    gains: (2, 2, T, n) what enters forecasts of q and of qd of what a rollout adds to q and to qd. trust: (2, T, n)
    0..1, the part of the mean square of what is to be added that forecasts of windows that they were not fitted to
    tell. held: (2, T, n) the part of the rollout with the disturbance held in what is followed. effect: (2, T, n) mean
    square of what holding it changed in training windows. limit: (2, T, n) how far rollouts are followed from
    extrapolated motion [rad, rad/s; m, m/s]: twice as far as a training window went, farther where they are trusted.
    error: (T, n) that of forecasts of windows that they were not fitted to, relative to the extrapolation's.
    """

    times: np.ndarray
    gains: np.ndarray
    trust: np.ndarray
    held: np.ndarray
    effect: np.ndarray
    limit: np.ndarray
    error: np.ndarray

    @cached_property
    def good_for(self) -> float | None:
        """The longest time [s] up to which forecasts are clearly better than extrapolated motion; None: none are."""
        found = None
        for time, error in zip(self.times, self.error.mean(axis=-1), strict=True):
            if time < SHORTEST * 0.9:
                continue
            if error > CLEAR:
                break
            found = float(f"{time:.2g}")
        return found

    def reaches(self, seconds: float) -> bool:
        """Whether training windows were that long, but for the rounding of samples."""
        return bool(seconds <= 1.05 * self.times[-1])

    def added(self, open_loop: np.ndarray, held: np.ndarray, times: np.ndarray) -> np.ndarray:
        """What to add to extrapolated motion, (2, W, K, n), of what rollouts add to it, at times (K,) [s]."""
        found = (self.gains, self.trust, self.held, self.effect, self.limit)
        gains, trust, part, effect, limit = (at_times(x, self.times, times) for x in found)
        unheld, held = (bounded(x, limit) for x in (open_loop, held))
        part = part[:, None, None]  # of q and of qd: both kinds of what rollouts add, mixed for each
        added: np.ndarray = np.einsum("scwkn,sckn->swkn", (1 - part) * unheld + part * held, gains)
        trust = trust[:, None]
        return added / (trust + (1 - trust) * unusual(_changed(open_loop, held), effect[:, None]))


def bounded(added: np.ndarray, limit: np.ndarray) -> np.ndarray:
    """What rollouts add, (2, W, T, n), shortened to go no farther than the limit, (2, T, n); 0 where it is no number.

    Position and velocity are shortened alike: they tell of the same force.
    """
    added = np.clip(np.nan_to_num(added), -FARTHEST, FARTHEST)
    times_as_far = np.abs(added) / np.maximum(limit, TINY)[:, None]
    shortened: np.ndarray = added / np.maximum(1, times_as_far.max(axis=0))
    return shortened


def unusual(changed: np.ndarray, usual: np.ndarray) -> np.ndarray:
    """How much more, squared, than within `CERTAIN` deviations holding a disturbance changes; 1 where it does not."""
    square = np.square(changed)
    usual = np.broadcast_to(CERTAIN**2 * usual, square.shape)
    return np.maximum(1, np.divide(square, usual, out=np.ones_like(square), where=usual > 0))


def _changed(open_loop: np.ndarray, held: np.ndarray) -> np.ndarray:
    """What holding the disturbance changes of rollouts, which may have left all bounds."""
    with np.errstate(invalid="ignore", over="ignore"):
        changed = np.nan_to_num(held - open_loop, nan=FARTHEST)
    return np.clip(changed, -FARTHEST, FARTHEST)


def calibrated(
    open_loop: np.ndarray, held: np.ndarray, measured: np.ndarray, blocks: np.ndarray, times: np.ndarray
) -> Trust:
    """The trust that windows of the training logs show. Arrays are (2, W, T, n): what is added to extrapolated motion.

    blocks: (W,), see `CalibrationWindows`.
    """
    limit = FOLLOWED * np.abs(measured).max(axis=1)  # (2, T, n)
    effect = np.square(_changed(open_loop, held)).mean(axis=1)
    rollouts = [bounded(x, limit) for x in (open_loop, held)]
    squares_alone = by_stretch(np.square(measured), blocks)
    alone = squares_alone.sum(axis=0)
    gains, part, error = np.zeros((2, *alone.shape)), np.zeros_like(alone), alone
    for mixture in MIXTURES:
        added = (1 - mixture) * rollouts[0] + mixture * rollouts[1]
        found, squares = _fitted(added, measured, squares_alone, blocks)
        better = squares < error
        gains, error = np.where(better[:, None], found, gains), np.where(better, squares, error)
        part = np.where(better, mixture, part)
    relative = np.divide(error, alone, out=np.ones_like(alone), where=alone > 0)
    trust = 1 - relative
    # what is trusted more may go farther, but how sure is trust that few stretches tell?
    farther = np.maximum(1, 1 / np.maximum(1 - trust**2, 1 / (blocks.max() + 1)) / FOLLOWED)
    return Trust(times, gains, trust, part, effect, farther * limit, np.sqrt(relative.mean(axis=0)))


def _fitted(
    added: np.ndarray, measured: np.ndarray, alone: np.ndarray, blocks: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Gains (2, 2, T, n), and the squared errors (2, T, n) of blocks that they were not fitted to.

    alone: (B, 2, T, n) the squares of what was measured.
    """
    products = by_stretch(added[:, None] * added[None], blocks)  # (B, 2, 2, T, n)
    with_measured = by_stretch(measured[:, None] * added[None], blocks)
    left_out = _gains(products.sum(axis=0) - products, with_measured.sum(axis=0) - with_measured)
    size = np.einsum("bsctn,bsdtn,bcdtn->bstn", left_out, left_out, products)
    product = np.einsum("bsctn,bsctn->bstn", left_out, with_measured)
    level, squares = _level(size, product, alone)
    (gains,) = _gains(*(x.sum(axis=0, keepdims=True) for x in (products, with_measured)))
    return level[:, None] * gains, squares


def _gains(products: np.ndarray, with_measured: np.ndarray) -> np.ndarray:
    """Least squares, (B, 2, 2, T, n)."""
    size = np.sqrt(np.maximum(np.einsum("bcctn->bctn", products), TINY))
    cosines = np.moveaxis(products / (size[:, :, None] * size[:, None]), (1, 2), (-2, -1))
    target = np.moveaxis(with_measured / size[:, None], (1, 2), (-1, -2))
    found = np.linalg.solve(cosines + LEAST * np.eye(2), target)  # (B, T, n, 2, 2), by kind added and told
    gains: np.ndarray = np.moveaxis(found, (-1, -2), (1, 2)) / size[:, None]
    return gains


def _level(size: np.ndarray, product: np.ndarray, alone: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How much of forecasts of blocks that they were not fitted to holds, (2, T, n), and the squares that it leaves.

    By block, (B, 2, T, n): the forecasts' squares, their products with what was measured, and the squares of that.
    """
    count = len(alone)
    level, left_out = (
        np.clip(x / np.maximum(y, TINY), 0, 1)
        for x, y in (
            (product.sum(axis=0), size.sum(axis=0)),
            (product.sum(axis=0) - product, size.sum(axis=0) - size),
        )
    )
    error = np.sqrt((count - 1) / count * np.square(left_out - left_out.mean(axis=0)).sum(axis=0))
    tried = np.clip(left_out - error, 0, 1)
    left = np.maximum(0, alone - 2 * tried * product + tried**2 * size)
    total = np.maximum(alone.sum(axis=0), TINY)
    part = left.sum(axis=0) / total
    chance = np.sqrt(count / (count - 1) * np.square(left - part * alone).sum(axis=0)) / total
    clear = part + certain(count) * chance < 1
    return np.where(clear, np.clip(level - error, 0, 1), 0), np.where(clear, left, alone).sum(axis=0)
