"""Identification of an arm from logs: base parameters, friction and drives by least squares, and how sure they are."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from spelgen.arm.actuation import Drives
from spelgen.arm.arm import Arm
from spelgen.dynamics.bristles import reach_of
from spelgen.dynamics.regressor import regressor
from spelgen.errors import Diagnostic, LogError
from spelgen.identification.base_parameters import BaseParameters, base_parameters
from spelgen.identification.friction import FrictionModel
from spelgen.identification.identification import Identification
from spelgen.identification.least_squares import Solution, Triangles, deviations, reduce, solve
from spelgen.identification.method import LeastSquares
from spelgen.identification.prior import GaussianPrior, gaussian_prior
from spelgen.identification.samples import DynamicsSamples, dynamics_samples
from spelgen.loaded_arm import LoadedArm, load_arm
from spelgen.logs.checks import check
from spelgen.logs.preprocessing import Preprocessing
from spelgen.logs.trajectory import Trajectory, require_joints, require_torques

_BLOCK = 2000  # samples in memory at a time
_ROUNDS = 4  # of weighing each joint by what is left of its torque
_LEAST_NOISE = 0.02  # of a joint's torque range: few samples may be fitted better than their model deserves


def identify(
    arm: LoadedArm | Path | str,
    logs: Trajectory | Sequence[Trajectory],
    method: LeastSquares | None = None,
    *,
    preprocessing: Preprocessing | None = None,
) -> Identification:
    """Fit base parameters, friction and armature of ``arm`` to the torques in ``logs``.

    arm: of ``load_arm``, or the path of a URDF. Torques of motors are taken to the joints' by its input matrix.
    preprocessing: its filter and gap. Raises LogError for logs that cannot be used, ArmError for a prior without
    inertials.
    """
    arm = arm if isinstance(arm, LoadedArm) else load_arm(arm)
    logs = [logs] if isinstance(logs, Trajectory) else logs
    coordinates, drives = arm.arm.coordinates, arm.actuation.drives()
    for trajectory in logs:
        require_joints(trajectory, [c.name for c in coordinates])
    require_torques(logs)
    notes = check(logs, [c.name for c in coordinates], [c.kind for c in coordinates])
    method = method or LeastSquares()
    kinds = [c.kind for c in coordinates]
    reach = reach_of(kinds, drives.speeds) if method.friction.memory else None
    samples = dynamics_samples(logs, preprocessing=preprocessing or Preprocessing(), reach=reach)
    left = sorted({x.name for x in logs} - {x.name for x in samples})
    if left:
        message = f"sampled too slowly or too short for accelerations: {', '.join(left)}"
        notes.append(Diagnostic("warning", "no-accelerations", "logs", None, message))
    at_joints = [replace(x, tau=x.tau @ drives.inputs.T) for x in samples]
    found = least_squares(arm.arm, at_joints, method, drives)
    return replace(found, diagnostics=tuple(notes))


def least_squares(
    arm: Arm,
    samples: Sequence[DynamicsSamples],
    method: LeastSquares | None = None,
    drives: Drives | None = None,
) -> Identification:
    """Fit ``arm`` to samples of joint torques; errors as for ``identify``.

    drives: those whose friction and armature are fitted; None: each moves its own joint alone.
    """
    method = method or LeastSquares()
    if not any(len(x.q) for x in samples):
        raise LogError(
            "no samples to identify from",
            expected="motion sampled at 50 Hz or faster, 1 s without a gap at least",
        )
    motors = None if drives is None else drives.speeds
    triangles = reduce((rows, tau) for rows, tau in _blocks(arm, samples, method.friction, motors))
    base = base_parameters(arm, method.friction, motors)
    prior = None
    if method.prior is not None:
        prior = gaussian_prior(arm, method.friction, triangles.deviation, method.prior)
    fit = _fitted(arm, samples, method, motors, _space(base, triangles, prior, method))
    return replace(_result(arm, samples, method, base, fit), drives=drives)


def columns(
    arm: Arm,
    friction: FrictionModel,
    q: np.ndarray,
    qd: np.ndarray,
    qdd: np.ndarray,
    z: np.ndarray | None = None,
    motors: np.ndarray | None = None,
) -> np.ndarray:
    """The whole regressor (T, n, 10 B + e n): the bodies', then that of friction and drives."""
    bent = None if z is None else z / reach_of([x.kind for x in arm.coordinates]).values
    return np.concatenate([regressor(arm, q, qd, qdd), friction.columns(qd, qdd, bent, motors)], axis=2)


@dataclass(frozen=True, eq=False)
class _Space:
    """The parameters that are fitted: x = start + basis z. penalty: of z; ridge: of it, times its column."""

    triangles: Triangles
    start: np.ndarray
    basis: np.ndarray
    penalty: np.ndarray | None
    ridge: float

    def solve(self, weights: np.ndarray) -> Solution:
        penalty = self.penalty
        if self.ridge:
            rows = (self.triangles.factors * weights[:, None, None])[..., :-1]
            length = np.sqrt(np.square(rows).sum(axis=(0, 1)))
            penalty = np.sqrt(self.ridge) * np.where(length > 0, length, 1.0)
        return solve(self.triangles, weights, self.basis, self.start, penalty)


@dataclass(frozen=True, eq=False)
class _Fit:
    """A solution, its weights (n,), and the errors that it leaves: standard deviations (n,) as if independent."""

    space: _Space
    solution: Solution
    weights: np.ndarray
    noise: np.ndarray

    def covariance(self) -> np.ndarray:
        """Of z, for errors as large as they turned out to be, whatever the weights were."""
        variance = np.square(self.weights**2 * self.noise)
        rows = self.space.triangles.factors[..., :-1] @ self.space.basis
        inner = np.einsum("j,jka,jkb->ab", variance, rows, rows)
        if self.space.penalty is not None:
            inner = inner + np.diag(self.space.penalty**2)
        return self.solution.covariance @ inner @ self.solution.covariance


def _space(
    base: BaseParameters, triangles: Triangles, prior: GaussianPrior | None, method: LeastSquares
) -> _Space:
    count = triangles.factors.shape[2] - 1
    if prior is not None:
        return _Space(triangles, prior.mean, prior.basis, 1.0 / prior.deviation, 0.0)
    if method.ridge:
        return _Space(triangles, np.zeros(count), np.eye(count), None, method.ridge)
    # each base parameter stands for the parameter that it is named after
    return _Space(triangles, np.zeros(count), np.eye(count)[:, base.columns], None, 0.0)


def _blocks(
    arm: Arm, samples: Sequence[DynamicsSamples], friction: FrictionModel, motors: np.ndarray | None
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    for each in samples:
        for start in range(0, len(each.q), _BLOCK):
            part = slice(start, start + _BLOCK)
            z = None if each.z is None else each.z[part]
            rows = columns(arm, friction, each.q[part], each.qd[part], each.qdd[part], z, motors)
            yield rows, each.tau[part]


def _fitted(
    arm: Arm,
    samples: Sequence[DynamicsSamples],
    method: LeastSquares,
    motors: np.ndarray | None,
    space: _Space,
) -> _Fit:
    deviation = space.triangles.deviation
    range_ = np.maximum(deviation, 1e-3 * deviation.max())
    weights = np.ones_like(range_) if method.weights == "equal" else 1.0 / range_
    for left in reversed(range(1 + (_ROUNDS if method.weights == "noise" else 0))):
        found = space.solve(weights)
        used = found.rank if space.penalty is None else 0
        residuals = [
            rows @ found.parameters - tau for rows, tau in _blocks(arm, samples, method.friction, motors)
        ]
        noise = np.maximum(deviations(residuals, used), _LEAST_NOISE * range_)
        if left:
            weights = 1.0 / noise
    return _Fit(space, found, weights, noise)


def _result(
    arm: Arm, samples: Sequence[DynamicsSamples], method: LeastSquares, base: BaseParameters, fit: _Fit
) -> Identification:
    triangles, found, basis = fit.space.triangles, fit.solution, fit.space.basis
    covariance = basis @ fit.covariance() @ basis.T
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
        unseen=0 if shown else basis.shape[1] - found.rank,
        residual=np.sqrt(squares),
        nmse=squares / np.where(triangles.deviation > 0, triangles.deviation, np.nan) ** 2,
        trajectories=tuple(x.name for x in samples),
        samples=triangles.count,
    )
