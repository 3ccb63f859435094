"""Costs of hypotheses about the geometry of a log: signs and order of joints, zero offsets, units, gravity.

A hypothesis is a change of the log's signals or of the arm's gravity that settings can express. The cost of a
hypothesis is the negative log posterior of the torques, minimised over inertial parameters, friction and the noise of
each joint. Between hypotheses that explain the torques equally well, the following terms decide: the prior of the
inertial parameters at the URDF, and penalties for negative rotor inertia, for friction that drives the motion, and for
positions beyond the limits of the joints.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import replace

import numpy as np
from scipy.linalg import block_diag

from spelgen.arm.arm import Chain
from spelgen.dynamics.regressor_dynamics import body_chain, urdf_parameters
from spelgen.identification.drive_hints import FRICTION, bristle_columns, drive_rows
from spelgen.identification.hypotheses import Hypothesis, HypothesisFit, Vector3
from spelgen.identification.least_squares import block_products, varying
from spelgen.identification.motion_samples import MotionSamples
from spelgen.identification.reference_inertials import ReferenceInertials, reference_inertials
from spelgen.identification.tuning import GEOMETRY
from spelgen.runtime.body_chain import BodyChain


class GeometryProblem:
    """Least-squares problem of the torques of a log, which can be solved under several hypotheses about the log."""

    def __init__(
        self,
        arm: Chain,
        samples: MotionSamples,
        speeds: np.ndarray,
        seconds: float,
        unchanged: Hypothesis | None = None,
    ) -> None:
        """Define the least-squares problem of the torques in logs of an arm with n joints.

        Args:
            arm: arm with its vector of gravity and the inertial parameters of its URDF.
            samples: samples of the motion, with joint torques.
            speeds: matrix C (n, n) from joint speeds to motor speeds, see `Drives`.
            seconds: duration of the logs [s], which limits the number of independent errors.
            unchanged: scales and offsets of the mapping of the logs; None: SI units and no offsets.
        """
        self.arm, self.speeds = arm, speeds
        self.unchanged = unchanged or Hypothesis.unchanged(arm)
        self.samples = self.unchanged.logged(samples)
        # Number of independent errors per joint. Torque residuals of recorded arms are correlated for about 0.2 s,
        # so that each 0.2 s count as one error. The number is at most 150, since the errors of a rigid model are
        # systematic and do not average out in long logs.
        self.count = float(np.clip(seconds / 0.2, 1.0, 150.0))
        self.reference = reference_inertials(arm)
        mean, precision = inertial_prior(arm, self.reference)
        self._bodies = len(mean)
        # indices of the mass and moments of inertia of the bodies that carry no joint
        parents = {body.parent for body in arm.bodies}
        self._last = [10 * k + i for k in range(len(arm.bodies)) if k not in parents for i in (0, 4, 7, 9)]
        drives = len(speeds) * len(FRICTION.effects)
        self.prior_mean = np.append(mean, np.zeros(drives))
        self._precision = block_diag(precision, np.zeros((drives, drives)))
        self._counted: np.ndarray | None = None
        self._has_free_gains = self._has_hysteresis = False
        self._equations: dict[tuple[bytes, Vector3], tuple[np.ndarray, np.ndarray]] = {}
        self._chains: dict[Vector3, BodyChain] = {}  # cache: {gravity vector: the arm's chain of bodies}

    def thinned(self, count: int) -> GeometryProblem:
        """Return the same least-squares problem on at most `count` samples, evenly spaced, to save time."""
        return self._with(samples=self.samples.thinned(count), _equations={})

    def selected(self, rows: np.ndarray) -> GeometryProblem:
        """Return the same least-squares problem on the samples that a mask (S,) selects."""
        return self._with(samples=self.samples.part(rows), _equations={})

    def _with(self, **changes: object) -> GeometryProblem:
        """Return a copy with other attributes; the cached equations are shared, unless they are changed, too."""
        changed = copy(self)
        vars(changed).update(changes)
        return changed

    def on_torques(self, counted: np.ndarray) -> GeometryProblem:
        """Return the least-squares problem in which only some of the torques are fitted.

        The other torques and their regressor rows become zero.

        counted: mask (S, n), True for the torques that are fitted, per sample and per joint of the arm. Hypotheses that
        exchange the columns of joints do not permute the mask.
        """
        return self._with(_counted=counted[..., None], _equations={})

    def with_hysteresis(self) -> GeometryProblem:
        """Return the same least-squares problem with a friction model with hysteresis.

        Its dry friction depends on the deflections of bristles, which are additional columns of the regressor.
        """
        added = self.samples.bent.shape[2] * len(self.speeds)
        mean = np.append(self.prior_mean, np.zeros(added))
        precision = block_diag(self._precision, np.zeros((added, added)))
        return self._with(_has_hysteresis=True, prior_mean=mean, _precision=precision, _equations={})

    def with_free_gains(self) -> GeometryProblem:
        """Return the same least-squares problem with an unknown positive factor on the torques of each joint.

        The factor is, for example, the unknown gain kp of a servo, whose torque is kp times the position error.
        """
        return self._with(_has_free_gains=True)

    def with_signs(self, signs: np.ndarray) -> GeometryProblem:
        """Return the least-squares problem with torques multiplied by `signs` (S, n): 1 or -1 per sample and joint.

        For example, `signs` restores the signs of torques that were logged as magnitudes.
        """
        return self._on_torques(self.samples.values[:, :, 3] * signs[..., None])

    def with_added_torques(self, torques: np.ndarray) -> GeometryProblem:
        """Return the least-squares problem with `torques` (S, n), in the unit of the log, added to the torques."""
        return self._on_torques(self.samples.values[:, :, 3] + torques[..., None])

    def _on_torques(self, tau: np.ndarray) -> GeometryProblem:
        """Return the least-squares problem with the torques tau (S, n, E), in the unit of the log."""
        values = self.samples.values.copy()
        values[:, :, 3] = tau
        return self._with(samples=self.samples._replace(values=values))

    def without_gravity(self, joint: int) -> GeometryProblem:
        """Return the least-squares problem with a model in which the torque of one joint contains no gravity.

        If it fits the unchanged log better than the problem with gravity, the logged torque of the joint contains no
        gravity.
        """
        weightless = replace(self.unchanged, gravity=(0.0, 0.0, 0.0))
        rows = self.equations(self.unchanged)[0].copy()
        rows[:, joint] = self.equations(weightless)[0][:, joint]
        return self._with(_equations={self.unchanged.motion_key: (rows, block_products(rows, 1)[:, 0])})

    def gravity_torques(self, fit: HypothesisFit) -> tuple[np.ndarray, np.ndarray]:
        """Return two gravity torques (S, n) [Nm, N] for comparison: with fitted parameters, and of `reference`.

        The hypothesis of `fit` determines the positions and the vector of gravity.
        """
        weightless = replace(fit.hypothesis, gravity=(0.0, 0.0, 0.0))
        columns = self.equations(fit.hypothesis)[0] - self.equations(weightless)[0]
        return columns @ fit.parameters, columns[..., : self._bodies] @ self.reference.parameters

    def reference_torques(self, hypothesis: Hypothesis) -> np.ndarray:
        """Return the torques (S, n) [Nm, N] of the motion under a hypothesis with the inertials of `reference`."""
        return np.asarray(self.equations(hypothesis)[0][..., : self._bodies] @ self.reference.parameters)

    def prediction_deviation(self, fit: HypothesisFit) -> np.ndarray:
        """Return the standard deviation (S, n) [Nm, N] of a fit's torques due to the covariance of its parameters."""
        rows, _ = self.equations(fit.hypothesis)
        return np.asarray(np.sqrt(np.einsum("snk,kl,snl->sn", rows, fit.covariance, rows, optimize=True)))

    def drive_parameters(self, fit: HypothesisFit) -> np.ndarray:
        """Return the rotor inertias and friction parameters of the n drives from a fit, (effects, n).

        The rows are in the order of `FRICTION.effects`: rotor inertia [kg m^2, kg], viscous friction [Nm s/rad, N s/m],
        Coulomb friction [Nm, N], and so on.
        """
        return fit.parameters[self._bodies :].reshape(-1, len(self.speeds))

    def residual(self, hypothesis: Hypothesis, parameters: np.ndarray) -> np.ndarray:
        """Return the torques of the model with parameters (K,) minus the logged torques, (S, n) [Nm, N].

        The logged torques and the motion are first corrected by ``hypothesis``.
        """
        torque = self.equations(hypothesis)[0] @ parameters
        return np.asarray(torque - hypothesis.signals(self.samples).tau)

    def equations(self, hypothesis: Hypothesis) -> tuple[np.ndarray, np.ndarray]:
        """Return the regressor Y (S, n, K) under a hypothesis, and Y^T Y of each joint, (n, K, K).

        The columns belong to the inertial parameters of the bodies, then to friction and rotor inertias. The 30 latest
        results are cached.
        """
        key = hypothesis.motion_key
        if key not in self._equations:
            q, qd, qdd = hypothesis.signals(self.samples).motion
            if hypothesis.gravity not in self._chains:
                self._chains[hypothesis.gravity] = body_chain(self.arm, hypothesis.gravity)
            rows = drive_rows(self._chains[hypothesis.gravity], q, qd, qdd, self.speeds)
            if self._has_hysteresis:
                # The deflections of the samples were computed with the current mapping. The hypothesis therefore
                # exchanges their joints and reverses their signs, as for the motion.
                bent = self.samples.bent[:, hypothesis.source[0]] * np.sign(hypothesis.scale[0])[:, None]
                rows = np.concatenate([rows, bristle_columns(bent, self.speeds)], axis=2)
            rows = rows if self._counted is None else rows * self._counted
            if len(self._equations) >= 30:  # bounds the memory of the cache: an entry has about 1 MB
                self._equations.pop(next(iter(self._equations)))
            self._equations[key] = rows, block_products(rows, 1)[:, 0]
        return self._equations[key]

    def fit(self, hypothesis: Hypothesis) -> HypothesisFit:
        """Return the fit that minimises the cost under a hypothesis, by iteratively reweighted least squares.

        The noise variance of each joint is marginalised: the joint's negative log likelihood is N / 2 log(sum of
        squared residuals), with the number N of independent errors. The prior of the inertial parameters is a Student t
        distribution, so that its precision is reweighted in each iteration.
        """
        rows, normal = self.equations(hypothesis)
        signals = hypothesis.signals(self.samples)
        tau = signals.tau if self._counted is None else signals.tau * self._counted[..., 0]
        right = (tau.T[:, None] @ rows.swapaxes(0, 1))[:, 0]
        total = np.maximum(np.square(tau).sum(axis=0), 1e-30)
        variance = len(tau) * _variance(tau)
        mean, precision, freedom = self.prior_mean, self._precision, self._bodies / 2
        errors, scale = np.full(len(normal), 0.1), 0.1
        x, gains, lowest = mean, np.ones(len(normal)), np.inf
        # Six reweightings suffice: further ones change the cost by less than 0.1. With unknown gains, the first six
        # iterations alternate between gains and parameters. The other eight are steps of both together, which converge
        # faster near the minimum. Under a wrong hypothesis these steps may oscillate, so the iteration of lowest cost
        # is used.
        for iteration in range(14 if self._has_free_gains else 6):
            if self._has_free_gains and iteration < 6:
                # The gain of a joint multiplies its logged torque. It is the inverse of the coefficient in a regression
                # of the logged torque on the model's torque. The correlation is bounded from below, so that the gain is
                # positive and finite even if both torques are not correlated.
                load = np.maximum((normal @ x) @ x, 1e-9 * total)
                correlation = right @ x / np.sqrt(load * total)
                gains = np.sqrt(load / total) / np.maximum(correlation, 0.3)
            weights = self.count / ((errors + GEOMETRY.error_floor) * variance * gains**2)
            matrix = (weights[None] @ normal.reshape(len(normal), -1)).reshape(precision.shape)
            matrix += scale * precision
            # a small ridge on the drive parameters, since the friction of a joint at rest is not identifiable; `drives`
            # is a view of the diagonal
            drives = np.einsum("kk->k", matrix)[self._bodies :]
            drives += 1e-9 * drives + 1e-9
            vector = (weights * gains) @ right + scale * precision @ mean
            if iteration < 6:
                x = solution(matrix, vector)
            else:
                x, gains = _joint_step(matrix, vector, weights * gains, gains, normal @ x, right @ x, x)
            squares = total - 2 * (right @ x) / gains + (normal @ x) @ x / gains**2
            errors = np.maximum(squares / variance, 0.0)
            distance = float((x - mean) @ precision @ (x - mean))
            scale = 2 * freedom / (freedom + distance)
            misfit = self.misfit(errors)
            cost = misfit + freedom * float(np.log1p(distance / freedom))
            if iteration == 0 or cost < lowest or not self._has_free_gains:
                lowest, best = cost, (x, errors, misfit, matrix)
        cost, (x, errors, misfit, matrix) = lowest, best
        covariance = inverse(matrix)
        cost += self._implausible(x, covariance, normal) + self._beyond_limits(signals.motion[0])
        return HypothesisFit(hypothesis, cost, misfit, x, covariance, errors)

    def explains(self, fit: HypothesisFit) -> bool:
        """Return True if a fit explains the torque of each moving joint, up to `GEOMETRY.exact` of its variance.

        The torque of a joint at rest may vary less than its noise, and is then not explained by any model.
        """
        moving = fit.hypothesis.signals(self.samples).moving_joints
        return bool(fit.errors[moving].max(initial=0.0) < GEOMETRY.exact)

    def misfit(self, errors: np.ndarray) -> float:
        """Return the negative log likelihood of the torques, up to a constant.

        errors: (n,) mean squared residual of each joint's torque, divided by the variance of the torque.
        """
        return 0.5 * self.count * float(np.log(errors + GEOMETRY.error_floor).sum())

    def step(self, fit: HypothesisFit, columns: np.ndarray) -> np.ndarray:
        """Return the Gauss-Newton step (D,) of D quantities of a hypothesis, such as a delay.

        The parameters of `fit` are estimated together with the quantities. columns: (S, n, D) derivative of the torque
        residual with respect to the quantities.
        """
        return solution(*self._linearized(fit, columns))[len(fit.parameters) :]

    def estimate(self, fit: HypothesisFit, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the Gauss-Newton step (K + D,) of K parameters and D quantities, and its covariance (K + D, K + D).

        The quantities belong to a hypothesis, for example delays or loads. columns: (S, n, D) derivative of the torque
        residual with respect to the quantities.
        """
        matrix, vector = self._linearized(fit, columns)
        return solution(matrix, vector), inverse(matrix)

    def _linearized(self, fit: HypothesisFit, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the matrix (K + D, K + D) and vector (K + D,) of the normal equations of `estimate`.

        The unknowns are steps of K parameters of the arm and of D quantities of a hypothesis, such as delays. The
        torque residual is linearized at `fit`. columns: (S, n, D) derivative of the residual at S samples with respect
        to the quantities.
        """
        rows, _ = self.equations(fit.hypothesis)
        tau, count = fit.hypothesis.signals(self.samples).tau, len(fit.parameters)
        weights = self.count / (len(tau) * (fit.errors + GEOMETRY.error_floor) * _variance(tau))
        joined = np.concatenate([rows, columns], axis=2) * np.sqrt(weights)[:, None]
        flat = joined.reshape(-1, joined.shape[2])
        matrix = flat.T @ flat
        matrix[:count, :count] += self._precision
        vector = flat.T @ ((tau - rows @ fit.parameters) * np.sqrt(weights)).ravel()
        vector[:count] += self._precision @ (self.prior_mean - fit.parameters)
        return matrix, vector

    def descend(
        self,
        at: Callable[[np.ndarray], Hypothesis],
        start: np.ndarray,
        *,
        largest: float,
        smallest: float,
        allowed: Callable[[np.ndarray], np.ndarray] = np.asarray,
    ) -> tuple[np.ndarray, HypothesisFit]:
        """Return continuous quantities (D,) of a hypothesis, such as a delay, that minimise the cost, and their fit.

        At most four Gauss-Newton steps are made. The descent ends when a step does not lower the cost, or is
        negligible.

        Args:
            at: function of the quantities (D,) that returns the hypothesis.
            start: (D,) initial values.
            largest: bound of each component of a step, which is clipped.
            smallest: norm below which a step is negligible.
            allowed: function of values (D,) after a step that returns the nearest allowed values.
        """
        values, fit = start, self.fit(at(start))
        difference = 1e-4 * largest
        for _ in range(4):
            residual = self.residual(fit.hypothesis, fit.parameters)
            columns = []
            for shift in difference * np.eye(len(values)):
                changed = self.residual(at(values + shift), fit.parameters)
                columns.append((changed - residual) / difference)
            step = np.clip(self.step(fit, np.stack(columns, axis=2)), -largest, largest)
            new = allowed(values + step)
            if np.linalg.norm(new - values) < smallest:
                break
            best = self.fit(at(new))
            if best.cost > fit.cost:
                break
            values, fit = new, best
        return values, fit

    def _beyond_limits(self, q: np.ndarray) -> float:
        """Return the penalty on the cost for positions q (S, n) beyond the position limits: at most 15 for each joint.

        The penalty of a joint is 15 min(1, 2 d / r), with the largest distance d of its positions beyond the limits and
        the range r between the limits. It is bounded, because limits of a URDF may be wrong and zeros may be calibrated
        badly. For a revolute joint, whose positions may be logged with another number of turns, d is the smallest
        distance without a shift and with shifts by plus or minus one turn.
        """
        penalty = 0.0
        for coordinate, low, high in zip(self.arm.coordinates, q.min(axis=0), q.max(axis=0), strict=True):
            lower, upper = coordinate.limits or (0.0, 0.0)
            if not 0 < upper - lower < 1e3:  # equal or huge limits mean that the joint is unlimited
                continue
            turns = 2 * np.pi * np.arange(-1, 2) * (coordinate.joint_type == "revolute")
            distance = np.maximum(high + turns - upper, lower - low - turns).min()
            penalty += 15.0 * float(np.clip(2 * distance / (upper - lower), 0.0, 1.0))
        return penalty

    def _implausible(self, x: np.ndarray, covariance: np.ndarray, normal: np.ndarray) -> float:
        """Return the penalty for negative inertias, and for friction that drives the motion on average.

        Three quantities must not be negative: the rotor inertias, the power that friction dissipates at each joint, and
        the mass and moments of inertia of bodies that carry no joint (their prior is wide). A negative quantity adds
        (quantity / standard deviation)^2 / 2 to the penalty, up to a bound. The bound is needed, since the right
        hypothesis may have one negative quantity: a drive may compensate friction, and errors of the friction model may
        resemble inertia. Of the arms of benchmarks/recordings.py, one has friction that drives the motion (joint 6),
        another one has a negative rotor inertia, and none has both.

        Args:
            x: (K,) parameters.
            covariance: (K, K) covariance of the parameters.
            normal: (n, K, K) Gram matrices of the regressor per joint.
        """
        drives, n = np.arange(len(normal)), len(normal)
        armature, viscous, coulomb = (self._bodies + n * effect + drives for effect in range(3))
        functionals = np.zeros((2 * n + len(self._last), len(x)))
        functionals[drives, armature] = 1.0
        # `functionals` @ x: first the n rotor inertias, then for each joint the power dissipated by friction, qd times
        # the friction torque, summed over the samples. The sums of qd times a column of friction are entries of the
        # joint's Gram matrix. Columns of bristles, if there are any, are the last ones: without them, friction with
        # hysteresis could drive the motion. The last rows are the mass and moments of inertia of bodies that carry no
        # joint.
        bristles = np.arange(self._bodies + n * len(FRICTION.effects), len(x)).reshape(n, -1).T
        for columns in (viscous, coulomb, *bristles):
            functionals[n + drives, columns] = normal[drives, viscous, columns]
        functionals[2 * n + np.arange(len(self._last)), self._last] = 1.0
        # friction of a joint at rest, whose velocity is noise, dissipates no power
        speed = np.sqrt(normal[drives, viscous, viscous])
        functionals[n + drives[speed < 0.01 * speed.max()]] = 0.0
        negative = np.minimum(functionals @ x, 0.0)
        variance = (functionals @ covariance * functionals).sum(axis=1)
        odds = 0.5 * np.square(negative) / np.maximum(variance, 1e-30)
        bounds = np.repeat([15.0, 10.0, 15.0], (n, n, len(self._last)))
        return float(np.minimum(odds, bounds).sum())


def _joint_step(
    matrix: np.ndarray,
    vector: np.ndarray,
    weights: np.ndarray,
    gains: np.ndarray,
    products: np.ndarray,
    agreement: np.ndarray,
    x: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the parameters (K,) and gains (n,) after a Gauss-Newton step of both.

    The cost is the sum over joints of s_k |tau_k - h_k Y_k x|^2 / 2, plus the prior of x, with the logged torque tau_k,
    the regressor Y_k, the weight s_k of the squared residual, and h_k = 1 / gain. The derivatives of the residual with
    respect to x and to h_k are -h_k Y_k and -Y_k x. The step changes log h_k by at least -0.7 and at most 1.

    Args:
        matrix: (K, K) Hessian of the cost with respect to x.
        vector: (K,) right-hand side of the normal equations for x.
        weights: (n,) s_k h_k.
        gains: (n,) current gains 1 / h_k.
        products: (n, K) Y_k^T Y_k x.
        agreement: (n,) tau_k^T Y_k x.
        x: (K,) current parameters.
    """
    count, coupling = len(x), weights[:, None] * products
    scale = weights * gains
    # `power` is the second derivative of the cost with respect to h_k, s_k |Y_k x|^2. Without a gravity or inertial
    # load, a joint's gain 1 / h_k is confounded with its friction: only friction / gain is determined, and the Hessian
    # is singular. The factor 1 + 1e-6 adds a small ridge on the change of h_k, with which such a gain remains at its
    # current value.
    power = scale * (products @ x) * (1 + 1e-6) + 1e-30
    whole = np.block([[matrix, coupling.T], [coupling, np.diag(power)]])
    step = solution(whole, np.append(vector, scale * agreement))
    return step[:count], gains / np.exp(np.clip(step[count:] * gains, -0.7, 1.0))


def inertial_prior(arm: Chain, reference: ReferenceInertials) -> tuple[np.ndarray, np.ndarray]:
    """Return the prior of the inertial parameters of B bodies: mean (10 B,) and precision (10 B, 10 B).

    The mean has the values of the URDF. Errors of masses, centres of mass and inertia tensors are independent. The
    prior of a body without <inertial> in the URDF, or with a copied mass, has mean 0 and is wide. The prior of a body
    that carries no joint includes a tool or load that the URDF does not contain. reference: inertial parameters, whose
    median mass is the typical mass of a body.
    """
    parameters = urdf_parameters(arm).reshape(-1, 10) * (not arm.masses_are_copied)
    masses = reference.parameters[::10]
    typical = float(np.median(masses[masses > 0])) if masses.any() else 1.0
    precisions = []
    for k, parameters_of_body in enumerate(parameters):
        lengths = [np.linalg.norm(np.array(x.translation, dtype=float)) for x in arm.bodies if x.parent == k]
        root = _root(parameters_of_body, float(max(lengths, default=0.0)), typical)
        covariance = root @ root.T
        if not lengths:
            deviations = GEOMETRY.load * typical * np.power(GEOMETRY.load_distance, [0, 1, 2])
            covariance += np.diag(np.square(np.repeat(deviations, (1, 3, 6))))
        precisions.append(np.linalg.inv(covariance))
    return parameters.ravel(), block_diag(*precisions)


def _root(own: np.ndarray, length: float, typical: float) -> np.ndarray:
    """Return a root R (10, 10) of the prior covariance R R^T of the inertial parameters (m, m c, I) of a body.

    The columns of R are the derivatives of the inertial parameters with respect to the mass (at a fixed shape), the
    centre of mass, and the inertia tensor about the centre of mass, each times a standard deviation. The standard
    deviations are half of the mass, half of the extent of the body, and half of mass * (radius of gyration)^2.

    Args:
        own: (10,) inertial parameters of the body in the URDF.
        length: largest distance from the body's origin to a joint that the body carries [m], from which the extent of
            the body is estimated.
        typical: mass assumed for a body without <inertial> [kg].
    """
    if own[0] <= 0:
        # without <inertial> the prior is wide: with the typical mass M [kg] and the distance L to the body's farthest
        # joint (at least 0.5 metres), the standard deviations are 20 M of the mass, 20 M L of the first moments, and 20
        # M L^2 of the moments of inertia
        extent = max(length, 0.5)
        return 20.0 * typical * np.diag(np.repeat([1.0, extent, extent**2], (1, 3, 6)))
    mass = own[0]
    center, moments = own[1:4] / mass, own[[4, 7, 9]]
    gyration = np.sqrt(max(float(moments.sum() / 2 / mass - center @ center), 0.0))
    extent = max(float(np.linalg.norm(center)), gyration, length / 2, 0.03)
    # the radius of gyration is bounded from below, since some URDFs contain point masses
    radius = max(gyration, 0.3 * extent)
    root = np.zeros((10, 10))
    root[:, 0] = own
    for axis, unit in enumerate(np.eye(3)):
        product = np.outer(center, unit) + np.outer(unit, center)
        tensor = np.trace(product) * np.eye(3) - product
        root[1:4, 1 + axis] = mass * extent * unit
        root[4:, 1 + axis] = mass * extent * tensor[np.triu_indices(3)]
    root[4:, 4:] = mass * radius**2 * np.eye(6)
    # The factor 0.5 makes each column of the root one standard deviation of the prior: half of the mass (column 0),
    # half of `extent`, the size of the body, for each coordinate of the centre of mass (columns 1 to 3), and half of
    # mass * (radius of gyration)^2 for each entry of the inertia tensor (columns 4 to 9).
    return 0.5 * root


def _variance(tau: np.ndarray) -> np.ndarray:
    """Return the variance (n,) of torques (S, n); infinity for a constant torque, which then has the weight zero."""
    return np.where(varying(tau), tau.var(axis=0), np.inf)


def inverse(matrix: np.ndarray) -> np.ndarray:
    """Return the inverse of a symmetric positive definite matrix (K, K), which is first scaled to a unit diagonal."""
    scaled, scale = _with_unit_diagonal(matrix)
    return np.linalg.inv(scaled) / np.outer(scale, scale)


def solution(matrix: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Return `inverse(matrix) @ vector`, (K,), for a matrix (K, K) and a vector (K,).

    The linear system is solved without computing the inverse, in a third of the time.
    """
    scaled, scale = _with_unit_diagonal(matrix)
    return np.asarray(np.linalg.solve(scaled, vector / scale) / scale)


def _with_unit_diagonal(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a positive semidefinite matrix (K, K) scaled to a unit diagonal, and its scale (K,).

    Rows and columns are divided by the scale, the square root of the diagonal. A tiny ridge makes the matrix
    invertible.
    """
    scale = np.sqrt(np.diagonal(matrix))
    scale = np.where(scale > 0, scale, 1.0)
    scaled = matrix / (scale[:, None] * scale)
    np.fill_diagonal(scaled, np.diagonal(scaled) + 1e-12)
    return scaled, scale
