"""Linear least squares on torque samples: n small triangles hold all that any weighting or prior needs of the logs."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

_NEGLIGIBLE = 1e-10  # of the largest singular value: a direction in which the samples say nothing
_LARGEST_LAG = 500  # samples over which residuals are followed in time

Columns = tuple[np.ndarray, np.ndarray]
"""Of some samples: the regressor (T, n, K) and the torque (T, n)."""


@dataclass(frozen=True, eq=False)
class Triangles:
    """The samples' normal equations by joint, as triangular factors (n, K + 1, K + 1) of [regressor, torque].

    count: samples. deviation: (n,) standard deviation of each joint's torque [Nm, N].
    """

    factors: np.ndarray
    count: int
    deviation: np.ndarray

    def squares(self, x: np.ndarray) -> np.ndarray:
        """Sums of squared residuals by joint, (n,), of the parameters x (K,)."""
        return np.square(self.factors @ np.append(x, -1.0)).sum(axis=1)


def reduce(blocks: Iterable[Columns]) -> Triangles:
    """The triangles of all blocks, one in memory at a time."""
    factors: list[np.ndarray] | None = None
    count, total, square = 0, 0.0, 0.0
    for regressor, torque in blocks:
        rows = np.concatenate([regressor, torque[:, :, None]], axis=2)
        joints = [rows[:, j] for j in range(rows.shape[1])]
        if factors is not None:
            joints = [np.concatenate(pair) for pair in zip(factors, joints, strict=True)]
        factors = [np.asarray(np.linalg.qr(joint, mode="r")) for joint in joints]
        count, total, square = count + len(torque), total + torque.sum(0), square + np.square(torque).sum(0)
    if factors is None or not count:
        raise ValueError("no samples")
    width = factors[0].shape[1]
    padded = [np.concatenate([x, np.zeros((width - len(x), width))]) for x in factors]
    deviation = np.sqrt(np.maximum(square / count - np.square(total / count), 0.0))
    return Triangles(np.stack(padded), count, deviation)


@dataclass(frozen=True, eq=False)
class Solution:
    """Parameters x = start + basis z of least squares.

    coordinates: z (r,). covariance: of z (r, r), where the weights are the inverse standard deviations of
    independent errors. condition: of the regressor with columns of length one; rank: directions that it shows.
    """

    parameters: np.ndarray
    coordinates: np.ndarray
    covariance: np.ndarray
    condition: float
    rank: int


def solve(
    triangles: Triangles,
    weights: np.ndarray,
    basis: np.ndarray,
    start: np.ndarray | None = None,
    penalty: np.ndarray | None = None,
) -> Solution:
    """The x = start + basis z with the least weighted squares and the least |penalty * z|^2.

    weights (n,) by joint, basis (K, r), start (K,), penalty (r,): the inverse standard deviations of a Gaussian
    prior on z around zero. Without penalty, directions that the samples do not show stay at zero.
    """
    x0 = np.zeros(len(basis)) if start is None else start
    weighted = (triangles.factors * weights[:, None, None]).reshape(-1, len(basis) + 1)
    rows, target = weighted[:, :-1] @ basis, weighted[:, -1] - weighted[:, :-1] @ x0
    if penalty is not None:
        rows = np.concatenate([rows, np.diag(penalty)])
        target = np.concatenate([target, np.zeros(len(penalty))])
    length = np.linalg.norm(rows, axis=0)
    length[length == 0] = 1.0
    left, values, right = np.linalg.svd(rows / length, full_matrices=False)
    shown = values > _NEGLIGIBLE * values[0]
    inverse = np.where(shown, 1.0 / np.where(shown, values, 1.0), 0.0)
    root = (right.T * inverse) / length[:, None]
    z = root @ (left.T @ target)
    condition = float(values[0] / values[-1]) if shown.all() else float("inf")
    return Solution(x0 + basis @ z, z, root @ root.T, condition, int(shown.sum()))


def deviations(residuals: Iterable[np.ndarray], used: int) -> np.ndarray:
    """Standard deviations (n,) of errors as if they were independent from sample to sample.

    residuals: (T, n) by trajectory; used: parameters fitted. Filtered and modelled torques err for many samples
    in the same sense: the variance is multiplied by the time over which residuals stay correlated, in samples
    (1 + 2 sum of autocorrelations up to the first below zero).
    """
    parts = list(residuals)
    count = sum(map(len, parts))
    variance = sum(np.square(x).sum(axis=0) for x in parts) / max(count - used / parts[0].shape[1], 1.0)
    return np.sqrt(variance * correlation_time(parts))


def correlation_time(residuals: list[np.ndarray]) -> np.ndarray:
    """How many successive samples err alike, (n,), at least one."""
    longest = min(_LARGEST_LAG, max(map(len, residuals)) - 1)
    power = sum(np.square(x).sum(axis=0) for x in residuals)
    time = np.ones_like(power)
    going = power > 0
    for lag in range(1, longest + 1):
        products = sum((x[lag:] * x[:-lag]).sum(axis=0) for x in residuals if len(x) > lag)
        going = going & (products > 0)
        if not going.any():
            break
        time = time + 2 * np.divide(products, power, out=np.zeros_like(power), where=going)
    return time
