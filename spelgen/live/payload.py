"""Estimate of a physically consistent payload, or of "no payload", from the state of the payload filter.

The payload filter gives a Gaussian of the ten inertial parameters theta. Divided by the filter's prior, this Gaussian
is the likelihood of theta. It is combined with another prior, a Wishart distribution of the pseudo-inertia with 6
degrees of freedom. The negative log posterior is then convex, and its minimum is physically consistent (Wensing, Kim
and Slotine, IEEE RA-L 3:60, 2018). Several priors with different mean masses are used. The hypotheses "payload" and "no
payload" are compared by Laplace's approximation of the evidence (MacKay, Neural Computation 4:415, 1992).
"""

import math
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import torch
from scipy.linalg import solve_triangular
from scipy.special import logsumexp, softmax

from spelgen.dynamics.body_regressor import about_center, pseudo_inertia
from spelgen.live.tuning import TUNING

Status = Literal["not yet", "no payload", "payload"]
_UNITS = pseudo_inertia(torch.eye(10).double()).numpy()
"""Derivative dJ/dtheta of the pseudo-inertia J with respect to the inertial parameters theta, (10, 4, 4)."""


@dataclass(frozen=True, eq=False)
class Payload:
    """Estimate of a payload that is fixed to the last body, in the frame of this body or of a link, see `at_link`.

    All attributes after `limit` are zero unless the status is "payload".

    Attributes:
        status: "payload", "no payload", or "not yet" if the motion does not determine whether there is a payload.
        log_odds: Log odds of "no payload" against a payload.
        limit: 95 % upper limit of the mass, for any status [kg].
        mass: Mass [kg].
        mass_interval: Lower and upper limit of the 95 % interval of the mass [kg].
        center: Centre of mass, (3,) [m].
        center_interval: Limits of 95 % intervals, (3, 2) [m].
        inertia: Inertia about the centre of mass, (xx, xy, xz, yy, yz, zz) [kg m^2].
        inertia_interval: Limits of 95 % intervals, (6, 2) [kg m^2].
        parameters: Mass m, first moments m c, and inertia about the origin of the frame, (10,).
        covariance: Covariance of the parameters, (10, 10).
        frame: Name of the link in whose frame the payload is described, or "the last body": the body of the last
            joint, with z along the axis of this joint.
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
    frame: str = "the last body"

    def at_link(self, link: str, pose: np.ndarray) -> "Payload":
        """Return a reported payload in the frame of a link, whose pose (4, 4) is in the frame of the last body."""
        # The pseudo-inertia J changes to P J P^T with the inverse pose P. It is linear in the parameters.
        inverse = np.linalg.inv(pose)
        changed = (inverse @ _UNITS @ inverse.T).reshape(10, 16)
        matrix = np.linalg.lstsq(_UNITS.reshape(10, 16).T, changed.T, rcond=None)[0]
        theta, spread = matrix @ self.parameters, matrix @ self.covariance @ matrix.T
        return _payload(theta, spread, self.log_odds, self.limit, link)


NO_REPORT = Payload()


def find_payload(mean: np.ndarray, covariance: np.ndarray, factor: float, quantile: float) -> Payload:
    """Return the payload that the state of the payload filter indicates: a physically consistent one, or "no payload".

    The status of the result is "not yet" if the evidence does not suffice, or if rounding errors make a matrix
    indefinite.

    Args:
        mean: inertial parameters estimated by the payload filter, (10,); the filter's prior is removed here.
        covariance: covariance of `mean`, (10, 10).
        factor: factor by which the covariance of the likelihood is multiplied (`NoiseLevels.load_variance`).
        quantile: half width of the 95 % intervals in standard deviations.
    """
    found: list[tuple[np.ndarray, np.ndarray, float]] = []
    try:
        precision = _inverse(covariance)
        linear = precision @ mean / factor
        precision = (precision - np.diag(1 / np.square(TUNING.load_prior))) / factor
        for scale in TUNING.scales:
            found.append(_at_scale(precision, linear, scale, found[-1][0] if found else None))
    except np.linalg.LinAlgError:
        return NO_REPORT
    thetas, inverses, evidence = (np.array(column) for column in zip(*found, strict=True))
    log_odds = float(math.log(len(found)) - logsumexp(evidence))
    weights = softmax(evidence)
    theta = weights @ thetas
    # The posterior is a mixture over the prior masses. The covariance of a mixture is the mean of the covariances plus
    # the covariance of the means.
    spread = np.tensordot(weights, inverses, 1) + np.cov(thetas.T, ddof=0, aweights=weights)
    # If the variance of the mass is nearly the filter's prior variance, the measurements do not determine the mass, as
    # for an arm of one joint, which determines only first moments. The Wishart prior then determines it in `theta`.
    variance = TUNING.load_prior[0] ** 2
    spread[0, 0] += variance * (covariance[0, 0] > 0.5 * variance)
    limit = theta[0] + quantile * math.sqrt(spread[0, 0])
    if log_odds > TUNING.payload_odds:
        is_none = log_odds > TUNING.no_payload_odds and spread[0, 0] < variance
        return Payload("no payload" if is_none else "not yet", log_odds, limit)
    return _payload(theta, spread, log_odds, limit, Payload.frame)


def _payload(theta: np.ndarray, spread: np.ndarray, log_odds: float, limit: float, frame: str) -> Payload:
    """Return a reported payload with its intervals.

    theta: inertial parameters in the frame, (10,). spread: covariance of theta. log_odds, limit, frame: see `Payload`.
    """
    # `limit` is the mass plus the quantile times its standard deviation, in any frame.
    quantile = (limit - theta[0]) / math.sqrt(spread[0, 0])
    # Intervals are computed from the derivatives of mass, centre of mass and inertia with respect to theta (delta
    # method). Complex-step derivatives have no cancellation errors (Squire and Trapp, SIAM Review 40:110, 1998).
    values, tiny = _mass_center_inertia(theta), 1e-30
    steps = [_mass_center_inertia(theta + tiny * 1j * unit).imag for unit in np.eye(10)]
    jacobian = np.array(steps).T / tiny
    half = quantile * np.sqrt(np.einsum("ki,ij,kj->k", jacobian, spread, jacobian))
    intervals = np.stack([values - half, values + half], axis=1)
    low, high = intervals[0].tolist()
    return Payload(
        "payload", log_odds, limit, float(values[0]), (max(low, 0.0), high), values[1:4], intervals[1:4],
        values[4:], intervals[4:], theta, spread, frame,
    )  # fmt: skip


def _inverse(matrix: np.ndarray) -> np.ndarray:
    """Return the inverse of a positive definite matrix, (k, k), whose entries may differ by orders of magnitude."""
    root = solve_triangular(np.linalg.cholesky(matrix), np.eye(len(matrix)), lower=True)
    return np.asarray(root.T @ root)


def _at_scale(
    precision: np.ndarray, linear: np.ndarray, scale: float, start: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return the MAP estimate of a payload's parameters, its covariance, and the log evidence, for one prior mean.

    Newton's method minimizes w (1/2 theta^T precision theta - linear . theta) - 1/2 log det J + 1/2 tr(W^-1 J), with
    the pseudo-inertia J of theta and the weight w of the likelihood. The other terms are the Wishart prior of J with
    `TUNING.degrees` = 6 degrees of freedom. Its scale matrix W is the pseudo-inertia of the prior mean, a homogeneous
    ball, divided by 6.

    Without a ``start``, Newton's method starts from the prior mean, and w increases to 1 in steps. With w = 1 from the
    beginning it would stall at the boundary of the cone of physically consistent parameters, because the maximum of the
    likelihood may be far outside of the cone (Boyd and Vandenberghe, Convex Optimization, 2004, 11.3). Twice the cost
    is self-concordant, so steps that are damped by the Newton decrement remain in the cone (9.6.4).

    Args:
        precision: inverse covariance of the likelihood, (10, 10).
        linear: precision times mean of the likelihood, (10,).
        scale: mass of the prior mean [kg].
        start: parameters from which Newton's method starts with w = 1, (10,).
    """
    # The prior mean is a homogeneous ball, whose centre is on the z axis of the last body at +`TUNING.distance`.
    height, about_z = TUNING.distance, 2 / 5 * TUNING.radius**2
    about_x = about_z + height**2
    mean = scale * np.array([1, 0, 0, height, about_x, 0, 0, about_x, 0, about_z])
    width = np.einsum("i,iab->ab", mean, _UNITS) / TUNING.degrees
    pull = 0.5 * np.einsum("iab,ba->i", _UNITS, _inverse(width))
    theta = mean if start is None else start

    for power in range(0 if start is not None else -TUNING.weights, 1):
        weight = 4.0**power
        for _ in range(TUNING.iterations):
            ratios = _inverse(np.einsum("i,iab->ab", theta, _UNITS)) @ _UNITS
            gradient = weight * (precision @ theta - linear) - 0.5 * np.einsum("iaa->i", ratios) + pull
            hessian = weight * precision + 0.5 * np.einsum("iab,jba->ij", ratios, ratios)
            inverse = _inverse(hessian)
            step = inverse @ gradient
            decrement = gradient @ step
            theta = theta - step / (1 + math.sqrt(2 * decrement) if decrement > 0.01 else 1)
            # Newton's method ends if the decrement is small. For a likelihood weight below 1, 0.1 suffices, because the
            # result is only the initial value for the next weight. For the weight 1 it must be below 1e-12, which
            # quadratic convergence reaches in a few steps.
            if decrement < (0.1 if power else 1e-12):
                break
    inertia = np.einsum("i,iab->ab", theta, _UNITS)
    log_width, log_hessian, log_inertia = (np.linalg.slogdet(x)[1] for x in (width, hessian, inertia))
    cost = 0.5 * theta @ precision @ theta - linear @ theta - 0.5 * log_inertia + pull @ theta
    return theta, inverse, float(TUNING.evidence - TUNING.degrees / 2 * log_width - cost - 0.5 * log_hessian)


def _mass_center_inertia(theta: np.ndarray) -> np.ndarray:
    """Return mass, centre of mass and inertia about the centre of mass of a payload as one array, (10,).

    theta: mass, first moment and inertia about the origin, (10,), real or complex. The elements of both inertias are
    (xx, xy, xz, yy, yz, zz).
    """
    mass, center, inertia = about_center(theta)
    return np.concatenate([[mass], center, inertia[np.triu_indices(3)]])
