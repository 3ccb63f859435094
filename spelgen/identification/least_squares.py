"""Linear least squares on torques, from one triangular factor per joint, independent of the weights of joints."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import pinv

from spelgen.identification.tuning import TUNING

Columns = tuple[np.ndarray, np.ndarray]
"""Regressor (T, n, K) and torque (T, n) [Nm, N] of T samples."""


@dataclass(frozen=True, eq=False)
class Triangles:
    """Triangular QR factors of the least-squares equations of each joint.

    factors: (n, K + 1, K + 1), upper triangular, of the rows [regressor, torque]. count: number of samples. deviation:
    (n,) standard deviation of the torque [Nm, N].
    """

    factors: np.ndarray
    count: int
    deviation: np.ndarray

    def squares(self, x: np.ndarray) -> np.ndarray:
        """Return the squared residual per joint, (n,) [Nm^2, N^2], of the parameters x (K,)."""
        return np.asarray(np.square(self.factors @ np.append(x, -1.0)).sum(axis=1))


def reduce(blocks: Iterable[Columns]) -> Triangles:
    """Return the factors of all blocks (T, n, K) and (T, n), one in memory at a time."""
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


def varying(tau: np.ndarray) -> np.ndarray:
    """Return True if torques (S, n) vary by more than the rounding errors of a constant, (n,)."""
    return np.asarray(tau.std(axis=0) > TUNING.negligible * np.abs(tau).max(axis=0))


def block_products(rows: np.ndarray, blocks: int) -> np.ndarray:
    """Return the Gram matrices (n, blocks, C, C) of the columns of rows (S, n, C), per joint and block of time.

    The last samples, which do not fill a block, are not used.
    """
    by_joint = rows[: len(rows) // blocks * blocks].swapaxes(0, 1)
    by_joint = by_joint.reshape(rows.shape[1], blocks, -1, rows.shape[2])
    return np.asarray(by_joint.swapaxes(2, 3) @ by_joint)


def normal_solution(products: np.ndarray, targets: int) -> np.ndarray:
    """Return the least-squares parameters (..., K, D) of D targets, from Gram matrices (..., K + D, K + D)."""
    # columns have different units (kg, kg m^2), and the Gram matrix squares the condition number: scaled to length one
    length = np.sqrt(np.diagonal(products, axis1=-2, axis2=-1))[..., :-targets, None]
    length = np.where(length > 0, length, 1.0)
    normal = products[..., :-targets, :-targets] / (length * length.swapaxes(-1, -2))
    normal = normal + TUNING.negligible * np.eye(length.shape[-2])
    return np.asarray(np.linalg.solve(normal, products[..., :-targets, -targets:] / length) / length)


@dataclass(frozen=True, eq=False)
class Solution:
    """Least-squares parameters (K,), zero except for the fitted columns (r,).

    covariance: (r, r) of the fitted parameters, for weights that are the inverse standard deviations of independent
    errors. condition, rank: of the regressor with columns of length one.
    """

    parameters: np.ndarray
    columns: np.ndarray
    covariance: np.ndarray
    condition: float
    rank: int

    def deviations(self, triangles: Triangles, errors: np.ndarray, combination: np.ndarray) -> np.ndarray:
        """Return the standard deviations (k,) of combinations of the fitted parameters, by the sandwich estimator.

        The weights need not be the inverse standard deviations of the errors (White, Econometrica 48:817, 1980).

        Args:
            triangles: of the samples.
            errors: (n,) standard deviations of the joints' torque errors, times the squares of their weights.
            combination: (k, r).
        """
        rows = triangles.factors[..., self.columns]
        effects = (combination @ self.covariance) @ rows.swapaxes(1, 2)
        return np.asarray(np.sqrt(np.tensordot(np.square(errors), np.square(effects).sum(axis=2), 1)))


def solve(triangles: Triangles, weights: np.ndarray, columns: np.ndarray) -> Solution:
    """Return the parameters that minimize the weighted squared residual; of minimum norm if it is singular.

    Args:
        triangles: of the samples.
        weights: (n,) of the joints.
        columns: (r,) of the fitted parameters.
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
    """Return standard deviations (n,) of the torque errors [Nm, N], scaled as if the errors of samples were
    independent.

    The residual of filtered torques is correlated: its variance is multiplied by its correlation time in samples.

    Args:
        residuals: (T, n) per trajectory.
        parameters: number of fitted parameters.
    """
    count = sum(map(len, residuals))
    power = sum(np.square(x).sum(axis=0) for x in residuals)
    variance = power / max(count - parameters / residuals[0].shape[1], 1.0)
    return np.asarray(np.sqrt(variance * correlation_time(residuals)))


def correlation_time(residuals: Sequence[np.ndarray]) -> np.ndarray:
    """Return the integrated autocorrelation time in samples, (n,), at least one, of residuals (T, n) per trajectory.

    It is 1 + 2 times the sum of the autocorrelations up to the first negative one (Geyer, Stat. Sci. 7:473, 1992).
    """
    max_lag = min(500, max(map(len, residuals)) - 1)  # 5 s
    power = sum(np.square(x).sum(axis=0) for x in residuals)
    time: np.ndarray = np.ones_like(power)
    correlated = power > 0
    for lag in range(1, max_lag + 1):
        products = np.zeros_like(power)
        for x in residuals:
            products += (x[lag:] * x[:-lag]).sum(axis=0)
        correlated &= products > 0
        if not correlated.any():
            break
        time = time + 2 * np.divide(products, power, out=np.zeros_like(power), where=correlated)
    return time
