"""Linear least squares on torques, from Gram matrices per joint.

The Gram matrices do not depend on the weights of the joints, so that fits with several weights need one pass over the
logs.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import pinvh

from spelgen.identification.tuning import TUNING


def varying(tau: np.ndarray) -> np.ndarray:
    """Return a mask (n,) of the joints whose torques tau (S, n) are not constant up to rounding errors."""
    return np.asarray(tau.std(axis=0) > TUNING.negligible * np.abs(tau).max(axis=0))


def block_products(rows: np.ndarray, blocks: int) -> np.ndarray:
    """Return the Gram matrices (n, blocks, C, C) of `rows` (S, n, C), per joint and contiguous block of samples.

    Samples at the end that do not fill a block are omitted.
    """
    by_joint = rows[: len(rows) // blocks * blocks].swapaxes(0, 1)
    by_joint = by_joint.reshape(rows.shape[1], blocks, -1, rows.shape[2])
    return np.asarray(by_joint.swapaxes(2, 3) @ by_joint)


def normal_solution(products: np.ndarray, targets: int) -> np.ndarray:
    """Return the least-squares parameters (..., K, D) for D target columns from Gram matrices (..., K + D, K + D).

    The Gram matrices belong to K regressor columns, followed by the D = `targets` target columns.
    """
    # Columns are scaled to length one: they have different units (kg, kg m^2), and the Gram matrix squares the
    # condition number.
    length = np.sqrt(np.diagonal(products, axis1=-2, axis2=-1))[..., :-targets, None]
    length = np.where(length > 0, length, 1.0)
    normal = products[..., :-targets, :-targets] / (length * length.swapaxes(-1, -2))
    normal = normal + TUNING.negligible * np.eye(length.shape[-2])
    return np.linalg.solve(normal, products[..., :-targets, -targets:] / length) / length


@dataclass(frozen=True, eq=False)
class Solution:
    """Solution of weighted linear least squares for r of K parameters.

    Attributes:
        parameters: (K,) all parameters; zero for parameters that are not fitted.
        columns: (r,) indices of the fitted parameters.
        covariance: (r, r) covariance of the fitted parameters if the errors are independent and the weights are the
            inverse standard deviations of the errors.
        condition: condition number of the weighted regressor with columns of length one; infinity if it is singular.
        rank: rank of this regressor.
    """

    parameters: np.ndarray
    columns: np.ndarray
    covariance: np.ndarray
    condition: float
    rank: int

    def deviations(self, products: np.ndarray, errors: np.ndarray, combination: np.ndarray) -> np.ndarray:
        """Return the standard deviations (k,) of k linear combinations of the fitted parameters.

        The sandwich estimator V M V, with V = `covariance`, M = sum over joints j of (s_j w_j^2)^2 Y_j^T Y_j and the
        regressor Y_j, is valid even if the weights w_j are not the inverse standard deviations of the errors (White,
        Econometrica 48:817, 1980).

        Args:
            products: (n, K + 1, K + 1) Gram matrices of the K regressor columns and the torque, per joint.
            errors: (n,) s_j w_j^2, with the standard deviation s_j of the torque error and the weight w_j of joint j.
            combination: (k, r) coefficients of the r fitted parameters (`columns`) in each of the k combinations.
        """
        effects = combination @ self.covariance
        middle = np.tensordot(np.square(errors), products, 1)[np.ix_(self.columns, self.columns)]
        return np.asarray(np.sqrt((effects @ middle * effects).sum(axis=1)))


def solve(product: np.ndarray, columns: np.ndarray) -> Solution:
    """Return the parameters that minimize the weighted squared torque residual; of several minima, the shortest vector.

    Args:
        product: (K + 1, K + 1) Gram matrix of the weighted regressor and torque.
        columns: (r,) indices of the fitted parameters; the others are zero.
    """
    normal = product[np.ix_(columns, columns)]
    length = np.sqrt(normal.diagonal())
    length[length == 0] = 1.0
    scale = np.outer(length, length)
    inverse, rank = pinvh(normal / scale, rtol=TUNING.negligible, return_rank=True)
    inverse = inverse / scale
    parameters = np.zeros(len(product) - 1)
    parameters[columns] = inverse @ product[columns, -1]
    condition = float(np.sqrt(np.linalg.cond(normal / scale))) if rank == len(columns) else float("inf")
    return Solution(parameters, columns, inverse, condition, int(rank))


def deviations(residuals: Sequence[np.ndarray], parameters: int) -> np.ndarray:
    """Return standard deviations (n,) of the torque errors [Nm, N] for formulas that assume independent errors.

    The residuals of filtered torques are correlated in time. The variance of the residuals is therefore multiplied by
    the correlation time, in samples.

    Args:
        residuals: torque residuals (T, n) of each trajectory [Nm, N].
        parameters: number of fitted parameters.
    """
    count = sum(map(len, residuals))
    power = sum(np.square(x).sum(axis=0) for x in residuals)
    variance = power / max(count - parameters / residuals[0].shape[1], 1.0)
    return np.asarray(np.sqrt(variance * correlation_time(residuals)))


def correlation_time(residuals: Sequence[np.ndarray]) -> np.ndarray:
    """Return the integrated autocorrelation time (n,), in samples, of the residuals (T, n) of all trajectories.

    It is 1 plus twice the sum of the autocorrelations before the first negative one, a simpler form of the initial
    sequences of Geyer (Stat. Sci. 7:473, 1992).
    """
    max_lag = min(500, max(map(len, residuals)) - 1)  # [samples] largest lag, 5 s at 100 Hz
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
