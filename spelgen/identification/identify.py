"""Identification of an arm from logs: base parameters, friction and drives by least squares, and how sure they are."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from spelgen.arm.arm import Arm
from spelgen.dynamics.regressor import regressor
from spelgen.errors import LogError
from spelgen.identification.base_parameters import BaseParameters, base_parameters
from spelgen.identification.friction import FrictionModel
from spelgen.identification.least_squares import Solution, Triangles, deviations, reduce, solve
from spelgen.identification.prior import GaussianPrior, gaussian_prior
from spelgen.identification.samples import DynamicsSamples

Weights = Literal["equal", "range", "noise"]

_BLOCK = 2000  # samples in memory at a time
_ROUNDS = 4  # of weighing each joint by what is left of its torque
_LEAST_NOISE = 0.02  # of a joint's torque range: few samples may be fitted better than their model deserves


@dataclass(frozen=True)
class Method:
    """How parameters are fitted.

    weights: of the joints' squared errors: ``equal`` (a Nm is a Nm), by the ``range`` of each joint's torque, or
    by the ``noise`` that is left, found in a few rounds. ridge: times the squared length of each column, as a
    penalty; 0: none. prior: standard deviation of the bodies around the URDF's (see ``gaussian_prior``); it needs
    the weights ``noise``; None: none.
    """

    weights: Weights = "noise"
    ridge: float = 0.0
    prior: float | None = None
    friction: FrictionModel = field(default_factory=FrictionModel)


@dataclass(frozen=True, eq=False)
class Identification:
    """What least squares found of an arm with n joints and K parameters, r of them base parameters.

    parameters: (K,), whose torque is the fit's; without prior those outside the base are zero. values, deviations:
    (r,) of the base parameters. condition: of the regressor (columns of length one, joints weighted). unseen:
    directions of the base parameters in which these logs say nothing. residual: (n,) root mean square [Nm, N];
    nmse: (n,) its square by the torque's variance.
    """

    arm: Arm
    method: Method
    base: BaseParameters
    parameters: np.ndarray
    values: np.ndarray
    deviations: np.ndarray
    condition: float
    unseen: int
    residual: np.ndarray
    nmse: np.ndarray
    trajectories: tuple[str, ...]
    samples: int

    def torque(self, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
        """Joint torques (T, n) of the identified arm."""
        return columns(self.arm, self.method.friction, q, qd, qdd) @ self.parameters


def columns(arm: Arm, friction: FrictionModel, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
    """The whole regressor (T, n, 10 B + e n): the bodies', then that of friction and drives."""
    return np.concatenate([regressor(arm, q, qd, qdd), friction.columns(qd, qdd)], axis=2)


def identify(arm: Arm, samples: Sequence[DynamicsSamples], method: Method) -> Identification:
    """Fit ``arm`` to joint torques. Raises LogError without samples, ArmError for a prior without inertials."""
    if not any(len(x.q) for x in samples):
        raise LogError(
            "no samples to identify from",
            expected="motion sampled at 50 Hz or faster, 1 s without a gap at least",
        )
    triangles = reduce((rows, tau) for rows, tau in _blocks(arm, samples, method.friction))
    base = base_parameters(arm, method.friction)
    prior = None
    if method.prior is not None:
        prior = gaussian_prior(arm, method.friction, triangles.spread, method.prior)
    return _result(
        arm, samples, method, base, _fitted(arm, samples, method, _space(base, triangles, prior, method))
    )


@dataclass(frozen=True, eq=False)
class _Space:
    """The parameters that are fitted: x = start + outlay z. penalty: of z; ridge: of it, times its column."""

    triangles: Triangles
    start: np.ndarray
    outlay: np.ndarray
    penalty: np.ndarray | None
    ridge: float

    def solve(self, weights: np.ndarray) -> Solution:
        penalty = self.penalty
        if self.ridge:
            rows = (self.triangles.factors * weights[:, None, None])[..., :-1]
            length = np.sqrt(np.square(rows).sum(axis=(0, 1)))
            penalty = np.sqrt(self.ridge) * np.where(length > 0, length, 1.0)
        return solve(self.triangles, weights, self.outlay, self.start, penalty)


@dataclass(frozen=True, eq=False)
class _Fit:
    """A solution, its weights (n,), and the errors that it leaves: standard deviations (n,) as if independent."""

    space: _Space
    solution: Solution
    weights: np.ndarray
    noise: np.ndarray

    def covariance(self) -> np.ndarray:
        """Of z, for errors as large as they turned out to be, whatever the weights were."""
        spread = np.square(self.weights**2 * self.noise)
        rows = self.space.triangles.factors[..., :-1] @ self.space.outlay
        inner = np.einsum("j,jka,jkb->ab", spread, rows, rows)
        if self.space.penalty is not None:
            inner = inner + np.diag(self.space.penalty**2)
        return self.solution.covariance @ inner @ self.solution.covariance


def _space(base: BaseParameters, triangles: Triangles, prior: GaussianPrior | None, method: Method) -> _Space:
    count = triangles.factors.shape[2] - 1
    if prior is not None:
        return _Space(triangles, prior.start, prior.outlay, 1.0 / prior.deviation, 0.0)
    if method.ridge:
        return _Space(triangles, np.zeros(count), np.eye(count), None, method.ridge)
    # each base parameter stands for the parameter that it is named after
    return _Space(triangles, np.zeros(count), np.eye(count)[:, base.columns], None, 0.0)


def _blocks(
    arm: Arm, samples: Sequence[DynamicsSamples], friction: FrictionModel
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    for each in samples:
        for start in range(0, len(each.q), _BLOCK):
            part = slice(start, start + _BLOCK)
            yield columns(arm, friction, each.q[part], each.qd[part], each.qdd[part]), each.tau[part]


def _fitted(arm: Arm, samples: Sequence[DynamicsSamples], method: Method, space: _Space) -> _Fit:
    spread = space.triangles.spread
    range_ = np.maximum(spread, 1e-3 * spread.max())
    weights = np.ones_like(range_) if method.weights == "equal" else 1.0 / range_
    for left in reversed(range(1 + (_ROUNDS if method.weights == "noise" else 0))):
        found = space.solve(weights)
        used = found.rank if space.penalty is None else 0
        residuals = [rows @ found.parameters - tau for rows, tau in _blocks(arm, samples, method.friction)]
        noise = np.maximum(deviations(residuals, used), _LEAST_NOISE * range_)
        if left:
            weights = 1.0 / noise
    return _Fit(space, found, weights, noise)


def _result(
    arm: Arm, samples: Sequence[DynamicsSamples], method: Method, base: BaseParameters, fit: _Fit
) -> Identification:
    triangles, found, outlay = fit.space.triangles, fit.solution, fit.space.outlay
    covariance = outlay @ fit.covariance() @ outlay.T
    combined = base.combination @ covariance @ base.combination.T
    squares = triangles.squares(found.parameters) / triangles.count
    shown = fit.space.penalty is not None or method.ridge > 0
    return Identification(
        arm=arm,
        method=method,
        base=base,
        parameters=found.parameters,
        values=base.combination @ found.parameters,
        deviations=np.sqrt(np.diag(combined)),
        condition=found.condition,
        unseen=0 if shown else outlay.shape[1] - found.rank,
        residual=np.sqrt(squares),
        nmse=squares / np.where(triangles.spread > 0, triangles.spread, np.nan) ** 2,
        trajectories=tuple(x.name for x in samples),
        samples=triangles.count,
    )
