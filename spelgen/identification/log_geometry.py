"""Evidence for hypotheses about the geometry of a log: senses and order of joints, zero offsets, gravity, units.

A hypothesis changes the signals of a log, or the gravity of the arm, as lines of the settings would. Its cost is the
negative log posterior of the torques, minimised over inertial parameters, friction and the noise of each joint. The
prior at the URDF, and penalties for negative rotor inertia and for friction that drives, decide between hypotheses that
explain the torques equally well.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag

from spelgen.arm.arm import Chain
from spelgen.dynamics.regressor_dynamics import body_chain
from spelgen.identification.drive_hints import FRICTION, drive_rows
from spelgen.identification.least_squares import block_products, varying
from spelgen.identification.tuning import GEOMETRY

Vector3 = tuple[float, float, float]


class MotionSamples(NamedTuple):
    """Samples of motion and joint torques, (S, n) each: q, qd, qdd [rad, s; m, s], tau [Nm; N]."""

    q: np.ndarray
    qd: np.ndarray
    qdd: np.ndarray
    tau: np.ndarray

    @classmethod
    def joined(cls, samples: Sequence[MotionSamples]) -> MotionSamples:
        """Return several samples together."""
        return cls(*map(np.concatenate, zip(*samples, strict=True)))

    def thinned(self, count: int) -> MotionSamples:
        """Return at most `count` samples, evenly spaced."""
        stride = -(-len(self.q) // count) or 1
        return MotionSamples(*(column[::stride] for column in self))


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """Hypothesis: an assignment of the columns of a log to n joints, with scales and offsets, and a vector of gravity.

    codes: of the changes, as in findings; empty for the unchanged log. q of joint k is motion_scale[k] times the
    column of joint motion_source[k], plus offset[k] [rad, m]; its torque is torque_scale[k] times the column of joint
    torque_source[k]. gravity: in the frame of the root link [m/s^2].
    """

    codes: tuple[str, ...]
    motion_source: np.ndarray
    torque_source: np.ndarray
    motion_scale: np.ndarray
    torque_scale: np.ndarray
    offset: np.ndarray
    gravity: Vector3

    @classmethod
    def unchanged(cls, arm: Chain) -> Hypothesis:
        """Return the hypothesis of the unchanged log, in SI units and without offsets."""
        order, ones = np.arange(len(arm.coordinates)), np.ones(len(arm.coordinates))
        x, y, z = map(float, arm.gravity)
        return cls((), order, order, ones, ones, 0.0 * ones, gravity=(x, y, z))

    @property
    def motion_key(self) -> tuple[bytes, Vector3]:
        """Key of the regressor: motion and gravity."""
        arrays = (self.motion_source, self.motion_scale, self.offset)
        return b"".join(x.tobytes() for x in arrays), self.gravity

    def signals(self, samples: MotionSamples) -> MotionSamples:
        """Return the motion and torques that the logged samples represent under this hypothesis."""
        q, qd, qdd = (x[:, self.motion_source] * self.motion_scale for x in samples[:3])
        return MotionSamples(q + self.offset, qd, qdd, samples.tau[:, self.torque_source] * self.torque_scale)

    def logged(self, samples: MotionSamples) -> MotionSamples:
        """Return the logged columns that represent `samples` under this hypothesis: the inverse of `signals`."""
        motion, torque = np.argsort(self.motion_source), np.argsort(self.torque_source)
        q = (samples.q - self.offset) / self.motion_scale
        qd, qdd = samples.qd / self.motion_scale, samples.qdd / self.motion_scale
        tau = samples.tau / self.torque_scale
        return MotionSamples(q[:, motion], qd[:, motion], qdd[:, motion], tau[:, torque])


@dataclass(frozen=True, eq=False)
class HypothesisFit:
    """Least squares with the prior under a hypothesis.

    cost: negative log posterior up to a constant. misfit: its part from the torque residual. parameters: (K,), inertial
    parameters first. covariance: (K, K), posterior. errors: (n,) mean squared residual of each joint, relative to the
    variance of its torque.
    """

    hypothesis: Hypothesis
    cost: float
    misfit: float
    parameters: np.ndarray
    covariance: np.ndarray
    errors: np.ndarray


class GeometryProblem:
    """Least squares of the torques of a log under hypotheses about its geometry."""

    def __init__(
        self,
        arm: Chain,
        samples: MotionSamples,
        speeds: np.ndarray,
        seconds: float,
        unchanged: Hypothesis | None = None,
    ) -> None:
        """Prepare the problem of an arm with n joints.

        Args:
            arm: with its gravity and the inertial parameters of its URDF.
            samples: of its motion, with torques at the joints.
            speeds: C (n, n) of the motors, see `Drives`.
            seconds: duration of the logs [s], which limits the number of independent errors.
            unchanged: scales and offsets of the mapping of the logs; None: SI units and no offsets.
        """
        self.arm, self.speeds = arm, speeds
        self.unchanged = unchanged or Hypothesis.unchanged(arm)
        self.samples = self.unchanged.logged(samples)
        # Residuals of recorded arms are correlated for about 0.2 s: samples within it count as one independent error.
        # At most 150 errors per joint count: errors of a rigid model do not average out in long logs.
        self._count = float(np.clip(seconds / 0.2, 1.0, 150.0))
        mean, precision = inertial_prior(arm)
        self._bodies = len(mean)
        drives = len(speeds) * len(FRICTION.effects)
        self.prior_mean = np.append(mean, np.zeros(drives))
        self._precision = block_diag(precision, np.zeros((drives, drives)))
        self._counted: np.ndarray | None = None
        self._equations: dict[tuple[bytes, Vector3], tuple[np.ndarray, np.ndarray]] = {}

    def thinned(self, count: int) -> GeometryProblem:
        """Return the problem on at most `count` samples, evenly spaced."""
        fewer = copy(self)
        fewer.samples, fewer._equations = self.samples.thinned(count), {}
        return fewer

    def on_torques(self, counted: np.ndarray) -> GeometryProblem:
        """Return the problem with only some torques. counted: mask (S, n) for the columns of the unchanged log."""
        fewer = copy(self)
        fewer._equations, fewer._counted = {}, counted[..., None]
        return fewer

    def without_gravity(self, joint: int) -> GeometryProblem:
        """Return the problem of the unchanged log in which one joint's torque contains no gravity."""
        weightless = replace(self.unchanged, gravity=(0.0, 0.0, 0.0))
        rows = self.equations(self.unchanged)[0].copy()
        rows[:, joint] = self.equations(weightless)[0][:, joint]
        other = copy(self)
        other._equations = {self.unchanged.motion_key: (rows, block_products(rows, 1)[:, 0])}
        return other

    def prediction_deviation(self, fit: HypothesisFit) -> np.ndarray:
        """Return the standard deviation of the torques of a fit, (S, n) [Nm, N], from its parameters' covariance."""
        rows, _ = self.equations(fit.hypothesis)
        return np.asarray(np.sqrt(np.einsum("snk,kl,snl->sn", rows, fit.covariance, rows, optimize=True)))

    def drive_parameters(self, fit: HypothesisFit) -> np.ndarray:
        """Return the parameters of the drives in a fit, (effects, n), in the order of `drive_rows`."""
        return fit.parameters[self._bodies :].reshape(-1, len(self.speeds))

    def torque(self, hypothesis: Hypothesis, parameters: np.ndarray) -> np.ndarray:
        """Return the torques (S, n) of parameters (K,) under a hypothesis."""
        return np.asarray(self.equations(hypothesis)[0] @ parameters)

    def equations(self, hypothesis: Hypothesis) -> tuple[np.ndarray, np.ndarray]:
        """Return the regressor Y (S, n, K) under a hypothesis, and Y^T Y per joint, (n, K, K); the last ones are kept.

        The columns are the inertial parameters of the bodies, then friction and rotor inertias.
        """
        key = hypothesis.motion_key
        if key not in self._equations:
            q, qd, qdd, _ = hypothesis.signals(self.samples)
            rows = drive_rows(body_chain(self.arm, hypothesis.gravity), q, qd, qdd, self.speeds)
            rows = rows if self._counted is None else rows * self._counted
            if len(self._equations) >= 30:  # of about 1 MB each
                self._equations.pop(next(iter(self._equations)))
            self._equations[key] = rows, block_products(rows, 1)[:, 0]
        return self._equations[key]

    def fit(self, hypothesis: Hypothesis) -> HypothesisFit:
        """Return the fit that minimises the cost.

        The noise of a joint is marginalised: its log likelihood is -N / 2 log(residual sum of squares), minimised by
        reweighting. The prior is a Student t: `scale` is its weight of iteratively reweighted least squares.
        """
        rows, normal = self.equations(hypothesis)
        tau = hypothesis.signals(self.samples).tau
        tau = tau if self._counted is None else tau * self._counted[..., 0]
        right, total = np.einsum("snk,sn->nk", rows, tau), np.square(tau).sum(axis=0)
        variance = len(tau) * _variance(tau)
        mean, precision, freedom = self.prior_mean, self._precision, self._bodies / 2
        errors, scale = np.full(len(normal), 0.1), 0.1
        for _ in range(6):  # the costs change by less than 0.1 after
            weights = self._count / ((errors + GEOMETRY.error_floor) * variance)
            matrix = np.tensordot(weights, normal, 1)
            # the friction of a joint at rest is not identifiable
            ridge = 1e-9 * np.diag(matrix) + 1e-9
            ridge[: self._bodies] = 0.0
            covariance = inverse(matrix + scale * precision + np.diag(ridge))
            x = covariance @ (weights @ right + scale * precision @ mean)
            squares = total - 2 * right @ x + np.einsum("k,jkl,l->j", x, normal, x)
            errors = np.maximum(squares / variance, 0.0)
            distance = float((x - mean) @ precision @ (x - mean))
            scale = 2 * freedom / (freedom + distance)
        misfit = 0.5 * self._count * float(np.log(errors + GEOMETRY.error_floor).sum())
        cost = (
            misfit + freedom * float(np.log1p(distance / freedom)) + self._implausible(x, covariance, normal)
        )
        return HypothesisFit(hypothesis, cost, misfit, x, covariance, errors)

    def step(self, fit: HypothesisFit, columns: np.ndarray) -> np.ndarray:
        """Return the Gauss-Newton step (D,) of parameters with the torque Jacobian `columns` (S, n, D)."""
        rows, _ = self.equations(fit.hypothesis)
        tau, known = fit.hypothesis.signals(self.samples).tau, len(fit.parameters)
        weights = self._count / (len(tau) * (fit.errors + GEOMETRY.error_floor) * _variance(tau))
        joined = np.concatenate([rows, columns], axis=2) * np.sqrt(weights)[:, None]
        flat = joined.reshape(-1, joined.shape[2])
        matrix = flat.T @ flat
        matrix[:known, :known] += self._precision
        vector = flat.T @ ((tau - rows @ fit.parameters) * np.sqrt(weights)).ravel()
        vector[:known] += self._precision @ (self.prior_mean - fit.parameters)
        return np.asarray((inverse(matrix) @ vector)[known:])

    def _implausible(self, x: np.ndarray, covariance: np.ndarray, normal: np.ndarray) -> float:
        """Return the penalty of negative rotor inertias, and of friction whose mean power over the log is positive.

        Each adds half of its squared standard score, up to a bound: drives may compensate friction, and errors of the
        friction model may resemble inertia. Recorded arms have friction of positive power (shanghai, joint 6) or
        negative rotor inertia (airbot), not both.
        """
        drives, n = np.arange(len(normal)), len(normal)
        armature, viscous, coulomb = (self._bodies + n * effect + drives for effect in range(3))
        functionals = np.zeros((2 * n, len(x)))
        functionals[drives, armature] = 1.0
        # friction power: qd (viscous qd + Coulomb sign qd), summed over the samples
        functionals[n + drives, viscous] = normal[drives, viscous, viscous]
        functionals[n + drives, coulomb] = normal[drives, viscous, coulomb]
        negative = np.minimum(functionals @ x, 0.0)
        variance = np.einsum("ik,kl,il->i", functionals, covariance, functionals)
        odds = 0.5 * np.square(negative) / np.maximum(variance, 1e-30)
        return float(np.minimum(odds, np.repeat([15.0, 10.0], n)).sum())


def inertial_prior(arm: Chain) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean (10 B,) and the precision (10 B, 10 B) of the inertial parameters of B bodies, by the URDF.

    Errors of masses, centres of mass and tensors are independent; a body without an inertial has a wide prior about 0.
    """
    masses = [float(body.inertia[0]) for body in arm.bodies if body.inertia and body.inertia[0] > 0]
    typical = float(np.median(masses)) if masses else 1.0
    mean, precisions = [], []
    for k, body in enumerate(arm.bodies):
        lengths = [np.linalg.norm(np.array(x.translation, dtype=float)) for x in arm.bodies if x.parent == k]
        mean.append(np.array(body.inertia or (0.0,) * 10, dtype=float))
        root = _root(mean[-1], float(max(lengths, default=0.0)), typical)
        precisions.append(np.linalg.inv(root @ root.T))
    return np.concatenate(mean), block_diag(*precisions)


def _root(own: np.ndarray, length: float, typical: float) -> np.ndarray:
    """Return R (10, 10), with R R^T the prior covariance of the inertial parameters (m, m c, I) of a body.

    The columns are the derivatives with respect to the mass at a fixed shape, the centre of mass and the tensor about
    the centre, times their standard deviations. own: (10,) inertial parameters of the URDF. length: largest distance
    to a joint it carries [m]. typical: mass assumed for a body without an inertial [kg].
    """
    if own[0] <= 0:
        # wide: an extent of half a metre, a standard deviation of 20 times the mass of another body
        extent = max(length, 0.5)
        return 20.0 * typical * np.diag(np.repeat([1.0, extent, extent**2], (1, 3, 6)))
    mass = own[0]
    center, moments = own[1:4] / mass, own[[4, 7, 9]]
    gyration = np.sqrt(max(float(moments.sum() / 2 / mass - center @ center), 0.0))
    extent = max(float(np.linalg.norm(center)), gyration, length / 2, 0.03)
    radius = max(gyration, 0.3 * extent)  # URDFs state point masses, too
    root = np.zeros((10, 10))
    root[:, 0] = own
    for axis, unit in enumerate(np.eye(3)):
        product = np.outer(center, unit) + np.outer(unit, center)
        tensor = np.trace(product) * np.eye(3) - product
        root[1:4, 1 + axis] = mass * extent * unit
        root[4:, 1 + axis] = mass * extent * tensor[np.triu_indices(3)]
    root[4:, 4:] = mass * radius**2 * np.eye(6)
    # URDFs are wrong by half: their masses, their centres of mass relative to the extent, their tensors
    return 0.5 * root


def _variance(tau: np.ndarray) -> np.ndarray:
    """Return the variance (n,) of torques (S, n); infinite for a constant torque, which has no information."""
    return np.asarray(np.where(varying(tau), tau.var(axis=0), np.inf))


def inverse(matrix: np.ndarray) -> np.ndarray:
    """Return the inverse of a symmetric positive matrix, scaled to a unit diagonal."""
    length = np.sqrt(np.diag(matrix))
    length = np.where(length > 0, length, 1.0)
    scaled = matrix / np.outer(length, length) + 1e-12 * np.eye(len(matrix))
    return np.asarray(np.linalg.inv(scaled) / np.outer(length, length))
