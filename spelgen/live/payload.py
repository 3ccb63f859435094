"""The payload from the state of the payload filter: physically consistent, or none.

The likelihood of the ten inertial parameters theta is the filter's Gaussian with its prior removed. The prior of a
payload is a Wishart distribution of its pseudo-inertia with 6 degrees of freedom, so that the negative log posterior
is convex and its minimum is physically consistent (Wensing, Kim and Slotine, IEEE RA-L 3:60, 2018). Prior means of
several masses are compared with "no payload" by Laplace's approximation of the evidence (MacKay, Neural Computation
4:415, 1992).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import torch
from scipy.linalg import solve_triangular

from spelgen.dynamics.body_regressor import pseudo_inertia
from spelgen.live.tuning import TUNING

Status = Literal["not yet", "no payload", "payload"]
_UNITS = pseudo_inertia(torch.eye(10).double()).numpy()
"""dJ/dtheta, (10, 4, 4)."""
LOAD_PRIOR = np.array([TUNING.load_mass] + 3 * [TUNING.load_moment] + 6 * [TUNING.load_inertia])
_DEGREES = 6  # of freedom of the Wishart distribution
ITERATIONS = 40
WEIGHTS = 12  # weights of the likelihood below one, powers of 1/4
# Constant of the log evidence: of the Wishart density, with |dJ/dtheta| = 1/2, and of the Gaussian of Laplace's
# approximation.
_LOG_GAMMA = 3 * math.log(math.pi) + sum(math.lgamma((_DEGREES - k) / 2) for k in range(4))
EVIDENCE = -2 * _DEGREES * math.log(2) - _LOG_GAMMA - math.log(2) + 5 * math.log(2 * math.pi)
_NORMAL = 1.96  # standard deviations of a 95 % interval
_INERTIA = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


@dataclass(frozen=True, eq=False)
class Payload:
    """Inertial parameters that the last body carries in addition to the arm, in its frame; zero without a payload.

    status: "not yet" if the motion does not determine it. log_odds: of "no payload" against a payload. limit: upper
    limit of the mass, 95 %, for any status [kg]. mass [kg], center (3,) [m], inertia about the centre of mass (xx,
    xy, xz, yy, yz, zz) [kg m^2]: with lower and upper limits of 95 % intervals, (..., 2). parameters: (10,), m, m c,
    and the inertia about the origin of the frame. covariance: of the parameters, (10, 10).
    """

    status: Status = "not yet"
    log_odds: float = 0.0
    limit: float = math.inf
    mass: float = 0.0
    mass_interval: tuple[float, float] = (0.0, 0.0)
    center: np.ndarray = field(default_factory=lambda: np.zeros(3))
    center_interval: np.ndarray = field(default_factory=lambda: np.zeros((3, 2)))
    inertia: np.ndarray = field(default_factory=lambda: np.zeros(6))
    inertia_interval: np.ndarray = field(default_factory=lambda: np.zeros((6, 2)))
    parameters: np.ndarray = field(default_factory=lambda: np.zeros(10))
    covariance: np.ndarray = field(default_factory=lambda: np.zeros((10, 10)))


NO_REPORT = Payload()


def find_payload(mean: np.ndarray, covariance: np.ndarray, factor: float) -> Payload:
    """Return the payload for the estimate of the payload filter, mean (10,) and covariance (10, 10).

    factor: on the covariance of the likelihood. "not yet" also if rounding errors make a matrix indefinite.
    """
    try:
        return _found_payload(mean, covariance, factor)
    except np.linalg.LinAlgError:
        return NO_REPORT


def _found_payload(mean: np.ndarray, covariance: np.ndarray, factor: float) -> Payload:
    """Return the payload; arguments: see `find_payload`. Raises LinAlgError if a matrix is not positive definite."""
    precision = _inverse(covariance)
    linear = precision @ mean / factor
    precision = (precision - np.diag(LOAD_PRIOR**-2.0)) / factor
    found: list[tuple[np.ndarray, np.ndarray, float]] = []
    theta = None
    for scale in TUNING.scales:
        found.append(_at_scale(precision, linear, scale, theta))
        theta = found[-1][0]
    evidence = np.array([each[2] for each in found])
    best = evidence.max()
    weights = np.exp(evidence - best)
    log_odds = -(best + math.log(weights.sum() / len(weights)))
    weights /= weights.sum()
    theta = np.zeros(10)
    for weight, (parameters, _, _) in zip(weights, found, strict=True):
        theta += weight * parameters
    spread = np.zeros((10, 10))
    for weight, (parameters, inverse, _) in zip(weights, found, strict=True):
        spread += weight * (inverse + np.outer(parameters - theta, parameters - theta))
    limit = theta[0] + _NORMAL * math.sqrt(spread[0, 0])
    if log_odds > TUNING.payload_odds:
        return Payload("no payload" if log_odds > TUNING.no_payload_odds else "not yet", log_odds, limit)
    return _described(theta, spread, log_odds, limit)


def _inverse(matrix: np.ndarray) -> np.ndarray:
    """Return the inverse of a positive definite matrix, whose entries may differ by orders of magnitude."""
    root = solve_triangular(np.linalg.cholesky(matrix), np.eye(len(matrix)), lower=True)
    inverse: np.ndarray = root.T @ root
    return inverse


def _at_scale(
    precision: np.ndarray, linear: np.ndarray, scale: float, start: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return the MAP estimate, its covariance, and the log evidence, for a prior mean of mass ``scale``.

    Newton's method for weight (1/2 theta^T precision theta - linear . theta) - 1/2 log det J + 1/2 tr(W^-1 J), from
    ``start``, or from the prior mean with an increasing weight: the likelihood may be largest far outside of the cone
    of consistent parameters, at whose boundary Newton's method would stall (Boyd and Vandenberghe, Convex
    Optimization, 2004, 11.3). Twice the cost is self-concordant: steps damped by its decrement are feasible (9.6.4).
    """
    variances = np.array([TUNING.radius**2 / 5] * 3)
    height = TUNING.distance
    around = scale * (variances[0] + variances[1] + np.array([height**2, height**2, 0.0]))
    mean = np.array([scale, 0, 0, scale * height, around[0], 0, 0, around[1], 0, around[2]])
    width = np.einsum("i,iab->ab", mean, _UNITS) / _DEGREES
    pull = 0.5 * np.einsum("iab,ba->i", _UNITS, _inverse(width))
    theta = mean if start is None else start

    for power in range(0 if start is not None else -WEIGHTS, 1):
        weight = 4.0**power
        for _ in range(ITERATIONS):
            ratios = _inverse(np.einsum("i,iab->ab", theta, _UNITS)) @ _UNITS
            gradient = weight * (precision @ theta - linear) - 0.5 * np.einsum("iaa->i", ratios) + pull
            hessian = weight * precision + 0.5 * np.einsum("iab,jba->ij", ratios, ratios)
            inverse = _inverse(hessian)
            step = inverse @ gradient
            decrement = gradient @ step
            theta = theta - step / (1 + math.sqrt(2 * decrement) if decrement > 0.01 else 1)
            # the error after a full step is about the square of the one before
            if decrement < (0.1 if power else 1e-8):
                break
    _, log_width = np.linalg.slogdet(width)
    _, log_hessian = np.linalg.slogdet(hessian)
    _, log_inertia = np.linalg.slogdet(np.einsum("i,iab->ab", theta, _UNITS))
    cost = 0.5 * theta @ precision @ theta - linear @ theta - 0.5 * log_inertia + pull @ theta
    return theta, inverse, float(EVIDENCE - _DEGREES / 2 * log_width - cost - 0.5 * log_hessian)


def _described(theta: np.ndarray, covariance: np.ndarray, log_odds: float, limit: float) -> Payload:
    """Return the payload with parameters (10,) and their covariance (10, 10); intervals by linearisation."""
    mass, moment = theta[0], theta[1:4]
    center = moment / mass
    by_center = np.zeros((3, 10))
    by_center[:, 0] = -center / mass
    by_center[:, 1:4] = np.eye(3) / mass
    # inertia about the centre of mass: I - (|h|^2 1 - h h^T) / m, with h = m c
    inertia, by_inertia = np.zeros(6), np.zeros((6, 10))
    for k, (row, column) in enumerate(_INERTIA):
        same = float(row == column)
        shift = same * (center @ center) - center[row] * center[column]
        inertia[k] = theta[4 + k] - mass * shift
        by_inertia[k, 4 + k] = 1.0
        by_inertia[k, 0] = shift
        by_inertia[k, 1:4] = -2 * same * center
        by_inertia[k, 1 + row] += center[column]
        by_inertia[k, 1 + column] += center[row]
    half = _NORMAL * math.sqrt(covariance[0, 0])

    def interval(values: np.ndarray, jacobian: np.ndarray) -> np.ndarray:
        """Return 95 % intervals (K, 2) of values (K,) with derivatives (K, 10)."""
        widths = _NORMAL * np.sqrt(np.einsum("ki,ij,kj->k", jacobian, covariance, jacobian))
        return np.stack([values - widths, values + widths], axis=1)

    return Payload(
        "payload", log_odds, limit, mass, (max(mass - half, 0.0), mass + half), center, interval(center, by_center),
        inertia, interval(inertia, by_inertia), theta, covariance,
    )  # fmt: skip
