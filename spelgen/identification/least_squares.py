"""Solve least squares on torques: n small triangles hold all that a weighting needs of the logs."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import pinv

from spelgen.identification.tuning import TUNING

Columns = tuple[np.ndarray, np.ndarray]
"""Of some samples: the regressor (T, n, K) and the torque (T, n)."""


@dataclass(frozen=True, eq=False)
class Triangles:
    """Hold the normal equations of samples by joint: triangular factors (n, K + 1, K + 1) of [regressor, torque].

    count: samples. deviation: (n,) standard deviation of each joint's torque [Nm, N].
    """

    factors: np.ndarray
    count: int
    deviation: np.ndarray

    def squares(self, x: np.ndarray) -> np.ndarray:
        """Return sums of squared residuals by joint, (n,), of the parameters x (K,)."""
        return np.asarray(np.square(self.factors @ np.append(x, -1.0)).sum(axis=1))


def reduce(blocks: Iterable[Columns]) -> Triangles:
    """Return the triangles of all blocks, one in memory at a time."""
    factors: np.ndarray | None = None
    count, total, square = 0, 0.0, 0.0
    for regressor, torque in blocks:
        rows = np.concatenate([regressor, torque[:, :, None]], axis=2).swapaxes(0, 1)
        if factors is not None:
            rows = np.concatenate([factors, rows], axis=1)
        factors = np.asarray(np.linalg.qr(rows, mode="r"))
        count, total, square = count + len(torque), total + torque.sum(0), square + np.square(torque).sum(0)
    deviation = np.sqrt(np.maximum(square / count - np.square(total / count), 0.0))
    return Triangles(np.asarray(factors), count, deviation)


def block_products(rows: np.ndarray, blocks: int) -> np.ndarray:
    """Return the products of the columns of rows (S, n, C) with one another, (n, blocks, C, C).

    By joint and block of time; samples that do not fill the last block are left out.
    """
    by_joint = rows[: len(rows) // blocks * blocks].swapaxes(0, 1)
    by_joint = by_joint.reshape(rows.shape[1], blocks, -1, rows.shape[2])
    return np.asarray(by_joint.swapaxes(2, 3) @ by_joint)


def normal_solution(products: np.ndarray, targets: int) -> np.ndarray:
    """Return the parameters (..., K, D) of least squares by products (..., K + D, K + D), for the last D columns."""
    # kilograms and kilogram square metres, in columns of one length: products square the spread
    length = np.sqrt(np.diagonal(products, axis1=-2, axis2=-1))[..., :-targets, None]
    length = np.where(length > 0, length, 1.0)
    normal = products[..., :-targets, :-targets] / (length * length.swapaxes(-1, -2))
    normal = normal + TUNING.negligible * np.eye(length.shape[-2])
    return np.asarray(np.linalg.solve(normal, products[..., :-targets, -targets:] / length) / length)


@dataclass(frozen=True, eq=False)
class Solution:
    """Parameters (K,) of least squares, of which those of some columns (r,) were fitted and the others are zero.

    covariance: of the fitted ones (r, r), where the weights are the inverse standard deviations of independent errors.
    condition: of the regressor with columns of length one; rank: directions that it shows.
    """

    parameters: np.ndarray
    columns: np.ndarray
    covariance: np.ndarray
    condition: float
    rank: int

    def deviations(self, triangles: Triangles, errors: np.ndarray, combination: np.ndarray) -> np.ndarray:
        """Return the standard deviations of combinations (k, r) of the fitted parameters.

        errors: (n,) standard deviations of the joints' torques, times the squares of their weights: a sandwich, for
        weights need not be the inverse of what the errors turned out to be.
        """
        rows = triangles.factors[..., self.columns]
        effects = (combination @ self.covariance) @ rows.swapaxes(1, 2)
        return np.asarray(np.sqrt(np.tensordot(np.square(errors), np.square(effects).sum(axis=2), 1)))


def solve(triangles: Triangles, weights: np.ndarray, columns: np.ndarray) -> Solution:
    """Return the parameters of these columns (r,) with the least weighted squares; weights (n,) by joint.

    Directions that the samples do not show stay at zero.
    """
    weighted = triangles.factors * weights[:, None, None]
    weighted = weighted.reshape(-1, weighted.shape[2])
    rows, target = weighted[:, columns], weighted[:, -1]
    length = np.linalg.norm(rows, axis=0)
    length[length == 0] = 1.0
    inverse, rank = pinv(rows / length, rtol=TUNING.negligible, return_rank=True)
    inverse = inverse / length[:, None]
    parameters = np.zeros(weighted.shape[1] - 1)
    parameters[columns] = inverse @ target
    condition = float(np.linalg.cond(rows / length)) if rank == len(columns) else float("inf")
    return Solution(parameters, columns, inverse @ inverse.T, condition, int(rank))


def deviations(residuals: Sequence[np.ndarray], parameters: int) -> np.ndarray:
    """Return standard deviations (n,) of errors as if they were independent from sample to sample.

    residuals: (T, n) by trajectory; parameters: that were fitted. Filtered and modelled torques err for many samples
    in the same sense: the variance is multiplied by the time over which residuals stay correlated, in samples.
    """
    count = sum(map(len, residuals))
    power = sum(np.square(x).sum(axis=0) for x in residuals)
    variance = power / max(count - parameters / residuals[0].shape[1], 1.0)
    return np.asarray(np.sqrt(variance * correlation_time(residuals)))


def correlation_time(residuals: Sequence[np.ndarray]) -> np.ndarray:
    """Return how many successive samples err alike, (n,), at least one.

    1 + 2 times the sum of autocorrelations up to the first below zero (Geyer, Stat. Sci. 7:473, 1992).
    """
    longest = min(TUNING.largest_lag, max(map(len, residuals)) - 1)
    power = sum(np.square(x).sum(axis=0) for x in residuals)
    time: np.ndarray = np.ones_like(power)
    correlated = power > 0
    for lag in range(1, longest + 1):
        products = np.zeros_like(power)
        for x in residuals:
            products += (x[lag:] * x[:-lag]).sum(axis=0)
        correlated &= products > 0
        if not correlated.any():
            break
        time = time + 2 * np.divide(products, power, out=np.zeros_like(power), where=correlated)
    return time
