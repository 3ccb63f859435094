"""How far predictions are to be followed from a constant velocity, as windows of the training logs show it.

A forecast is a combination of forecasts (Bates and Granger, Oper. Res. Q. 20:451, 1969): the constant velocity plus a
part of what a rollout adds to it. The part is a coefficient of least squares by joint and time ahead, less one
standard error by the jackknife over stretches of time, since errors of windows that overlap are alike; it is 0 where
windows that it was not fitted to are not predicted better by two standard errors. It is that of a joint as active as
in training. Of one that moves less there is less to predict, while what a model does not know stays as large: the
part is that of a signal of the window's own power in the same noise (Wiener).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

TIMES = (0.01, 0.02, 0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.7, 1.0)  # s
SHORTEST = 0.05  # s: of the horizons that a model is said to be good for
CLEAR = 0.9  # of the constant velocity's error, what a forecast's is at most where it is good
LEAST_BLOCKS = 3
CERTAIN = 2.0  # standard errors that a gain must be large
LEVELS = np.concatenate([[0.0], 1 / (1 + np.geomspace(1e3, 1e-3, 37)), [1.0]])
MIXTURES = (0.0, 0.5, 1.0)  # parts of the rollout with the disturbance held; the rest is that without
MOST_ACTIVE = 1e6


@dataclass(frozen=True, eq=False)
class Trust:
    """Of one predictor, at times (T,) [s].

    trust: (T, n) 0..1, of a joint as active as in training. held: (T, n) the part of the rollout with the disturbance
    held in what is trusted. limit: (2, T, n) the farthest that a training window went from a constant velocity, for q
    and qd [rad, rad/s; m, m/s]; a rollout that is not trusted at all is not followed farther. error: (T, n) that of
    forecasts of windows that they were not fitted to, relative to the constant velocity's.
    """

    times: np.ndarray
    trust: np.ndarray
    held: np.ndarray
    limit: np.ndarray
    error: np.ndarray

    @cached_property
    def good_for(self) -> float | None:
        """The longest time [s] up to which forecasts are clearly better than a constant velocity; None: none are."""
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

    def added(
        self, open_loop: np.ndarray, held: np.ndarray, activity: np.ndarray, times: np.ndarray
    ) -> np.ndarray:
        """What to add to a constant velocity, (2, W, K, n), of what rollouts add to it, at times (K,) [s].

        activity: (W, n), see `relative_activity`.
        """
        trust, mixture = (self._at(x, times) for x in (self.trust, self.held))
        limit = np.stack([self._at(x, times) for x in self.limit])[:, None]  # (2, 1, K, n)
        limit = limit / np.maximum(1 - trust**2, 1e-9)  # what is trusted fully may go anywhere
        active = activity[:, None]  # (W, 1, n)
        rollouts = [bounded(x, limit, active) for x in (open_loop, held)]
        return weight(trust, active) * ((1 - mixture) * rollouts[0] + mixture * rollouts[1])

    def _at(self, values: np.ndarray, times: np.ndarray) -> np.ndarray:
        """(T, n) at other times, (K, n)."""
        return np.stack([np.interp(times, self.times, column) for column in values.T], axis=-1)


def relative_activity(
    qd: np.ndarray, change: np.ndarray, trained_qd: np.ndarray, trained_change: np.ndarray
) -> np.ndarray:
    """How much joints move (W, n), squared, 1 as in training on average: by velocity and its change over the past."""
    squares = [
        np.square(x) / np.maximum(np.square(trained).mean(axis=0), 1e-12)
        for x, trained in ((qd, trained_qd), (change, trained_change))
    ]
    return np.minimum((squares[0] + squares[1]) / 2, MOST_ACTIVE)


def weight(trust: np.ndarray, activity: np.ndarray) -> np.ndarray:
    """The part to follow of what a rollout adds, where the motion has this power."""
    signal = activity * trust
    return signal / np.maximum(signal + 1 - trust, 1e-12)


def bounded(added: np.ndarray, limit: np.ndarray, activity: np.ndarray) -> np.ndarray:
    """Not farther from a constant velocity than in training; 0 where it is no number."""
    most = limit * np.sqrt(np.maximum(activity, 1))
    return np.clip(np.nan_to_num(added, posinf=np.inf, neginf=-np.inf), -most, most)


def calibrated(
    open_loop: np.ndarray,
    held: np.ndarray,
    measured: np.ndarray,
    activity: np.ndarray,
    blocks: np.ndarray,
    times: np.ndarray,
) -> Trust:
    """The trust that windows of the training logs show. Arrays are (2, W, T, n): what is added to a constant velocity.

    q and qd count alike. activity: (W, n). blocks: (W,), see `CalibrationWindows`.
    """
    limit = np.abs(measured).max(axis=1)  # (2, T, n)
    active = activity[:, None]  # (W, 1, n)
    size = np.sqrt(np.square(measured).sum(axis=1, keepdims=True))  # (2, 1, T, n)
    unit = np.where(size > 0, size, 1.0)
    rollouts = [bounded(x, limit[:, None], active) / unit for x in (open_loop, held)]
    still = np.square(measured / unit).sum(axis=(0, 1))  # (T, n)
    trust, mixture, error = np.zeros_like(still), np.zeros_like(still), still
    for part in MIXTURES:
        mixed = (1 - part) * rollouts[0] + part * rollouts[1]
        level, squares = _fitted(mixed, measured / unit, active, blocks)
        better = squares < error
        trust, error = np.where(better, level, trust), np.where(better, squares, error)
        mixture = np.where(better, part, mixture)
    relative = np.sqrt(np.divide(error, still, out=np.ones_like(still), where=still > 0))
    return Trust(times, trust, mixture, limit, relative)


def _fitted(
    added: np.ndarray, measured: np.ndarray, activity: np.ndarray, blocks: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Trust (T, n), and the squared errors of blocks that it was not fitted to."""
    count = blocks.max() + 1
    member = (blocks == np.arange(count)[:, None]).astype(float)  # (B, W)

    def missed(trust: np.ndarray) -> np.ndarray:
        """Squared errors of each block, (B, T, n)."""
        errors = np.square(measured - weight(trust, activity) * added).sum(axis=0)
        return np.einsum("bw,wtn->btn", member, errors)

    by_level = np.stack([missed(level) for level in LEVELS])  # (L, B, T, n)
    total = by_level.sum(axis=1)
    level, left_out = LEVELS[total.argmin(axis=0)], LEVELS[(total[:, None] - by_level).argmin(axis=0)]
    error = np.sqrt((count - 1) / count * np.square(left_out - left_out.mean(axis=0)).sum(axis=0))
    left, still = missed(np.clip(left_out - error, 0, 1)[blocks]), by_level[0]  # the first level is 0
    size = np.maximum(still.sum(axis=0), 1e-300)
    part = left.sum(axis=0) / size
    chance = np.sqrt(count / (count - 1) * np.square(left - part * still).sum(axis=0)) / size
    clear = part + CERTAIN * chance < 1
    return np.where(clear, np.clip(level - error, 0, 1), 0), np.where(clear, left, still).sum(axis=0)
