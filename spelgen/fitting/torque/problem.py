"""MAP estimation of rigid-body and friction parameters x from torques.

x contains log-Cholesky parameters of the bodies, which guarantee physically consistent inertias, and a few constants of
each joint. The cost is the negative log posterior of x,

    1/2 sum over joints j of |r_j(x)|^2 / s_j^2 + 1/2 (x - m)^T P (x - m),

with the torque residual r_j (T,) of joint j, its noise s_j, and a Gaussian prior of mean m and precision P. The prior
of each body is Student's t, represented by a Gaussian whose width is estimated (see `ParameterPrior`). If motor gains
are trained, r and s refer to the joint torque at the initial gains (see `TorqueJacobian.squared_residual`): the
residual at the current gains would vanish with the gains. Noise and prior widths are estimated from the logs: outer
iterations alternate Levenberg-Marquardt steps with updates of noise and prior widths.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import torch

from spelgen.fitting.levenberg_marquardt import (
    NormalEquations,
    SolverResult,
    SolverState,
    levenberg_marquardt,
)
from spelgen.fitting.torque.jacobian import ResidualSamples, TorqueJacobian
from spelgen.fitting.torque.linearization import (
    NO_TERMS,
    LinearTerms,
    RigidProjection,
    least_squares_residual,
)
from spelgen.fitting.torque.parameters import ParameterPrior, update_widths
from spelgen.fitting.torque.samples import TorqueSamples
from spelgen.fitting.torque.tuning import TUNING
from spelgen.identification.least_squares import correlation_time
from spelgen.settings.fits import Adaptation, GaussianPrior

UNBOUNDED = torch.tensor(torch.inf).double()
"""Bound of the torque errors of a fit that is not compared with a simpler method [Nm, N]."""
State = SolverState[torch.Tensor]
"""State of the solver: parameters x (K,), and as `residual` the squared torque residual per joint, (n,) [Nm^2, N^2]."""


@dataclass(frozen=True, eq=False)
class NoiseEstimator:
    """Estimator of the torque noise s (n,) [Nm, N] from the squared residual of `count` samples.

    s^2 is the mean squared residual times the correlation length. The sum over all samples of residual^2 / s^2 is then
    the number of independent errors instead of the number of samples. correlation_length: (n,), number of correlated
    samples that count as one independent error. The root mean square residual is limited first from above, by max_error
    (n,) [Nm, N], and then from below, by a fraction of torque_std (n,) [Nm, N], the standard deviation of the torque.
    """

    count: int
    correlation_length: torch.Tensor
    torque_std: torch.Tensor
    max_error: torch.Tensor = UNBOUNDED

    @classmethod
    def of(
        cls, jacobian: TorqueJacobian, correlation_time: torch.Tensor, max_error: torch.Tensor = UNBOUNDED
    ) -> NoiseEstimator:
        """Return the estimator for the samples of a Jacobian and the correlation times (n,) [s] of their errors.

        max_error: upper bound of the root mean square residual, (n,) [Nm, N].
        """
        correlation_length = (correlation_time / jacobian.samples.interval).clamp(min=1.0)
        # The standard deviation of the torque has a lower bound, which avoids divisions by zero at joints of constant
        # torque.
        torque_std = torch.maximum(jacobian.torque_std, 1e-3 * jacobian.torque_std.max())
        return cls(jacobian.samples.count, correlation_length, torque_std, max_error)

    @property
    def errors(self) -> torch.Tensor:
        """Number of independent torque errors in all samples, per joint, (n,)."""
        return self.count / self.correlation_length

    def upper_bound(self) -> torch.Tensor:
        """Return the noise (n,) [Nm, N] for the largest allowed RMS residual, min(`max_error`, `torque_std`).

        The noise is the root mean square (RMS) residual times sqrt(correlation length). A model with an RMS residual
        above `torque_std`, the standard deviation of the torque, would be worse than a constant torque.
        """
        return torch.minimum(self.max_error, self.torque_std) * self.correlation_length.sqrt()

    def estimate(
        self, squared_residual: torch.Tensor, effective_parameters: torch.Tensor | float = 0.0
    ) -> torch.Tensor:
        """Return the noise (n,) [Nm, N], s = RMS residual times sqrt(correlation length), for a squared residual.

        The correlation length is a number of samples. The root mean square (RMS) residual is corrected for the number
        of parameters and limited: to at most `max_error`, the RMS error of a simpler method, then to at least a
        fraction of `torque_std`, the standard deviation of the torque, also if that fraction exceeds `max_error`.

        Args:
            squared_residual: (n,) sum over all samples [Nm^2, N^2].
            effective_parameters: (n,) number of parameters that each joint's torque determines. It is subtracted from
                the number of independent errors, which gives the degrees of freedom of the residual.
        """
        # The degrees of freedom (independent errors minus parameters) are at least one. They could be negative
        # otherwise, since `TorqueProblem.updated` assigns an equal share of the parameters to each joint.
        fraction = (self.errors - effective_parameters).clamp(min=1.0) / self.errors
        rms = torch.minimum((squared_residual / self.count / fraction).sqrt(), self.max_error)
        return torch.maximum(rms, TUNING.min_noise * self.torque_std) * self.correlation_length.sqrt()

    def annealed(self, squared_residual: torch.Tensor) -> torch.Tensor:
        """Return the noise (n,) [Nm, N] for an iteration of noise annealing, a sequence of fits with falling noise.

        This noise is `annealing_fraction` times the noise that is estimated from the residual.

        squared_residual: (n,) sum over all samples [Nm^2, N^2].
        """
        return TUNING.annealing_fraction * (self.correlation_length * squared_residual / self.count).sqrt()


@dataclass(frozen=True, eq=False)
class TorqueProblem:
    """Negative log posterior of K parameters x (K,) for a given noise and prior: a `LeastSquaresProblem`.

    Attributes:
        jacobian: torque residual and its derivatives with respect to x, on T samples.
        noise: (n,) [Nm, N], scaled such that the errors of all samples can be treated as independent (see
            `NoiseEstimator`).
        prior: prior of x.
        adapt: purpose of the fit, which determines the estimated parameters: "load" (last body), "friction" (friction
            and torque offsets), "unit" (all, for another arm of the same type) or None (all).
        compensated: (n,), True for joints whose drives compensate friction (see `stages.find_compensation`).
        correlation_time: (n,) [s], correlation time of the torque errors.
        max_error: (n,) [Nm, N], upper bound of the root mean square torque error, for example the held-out error of
            ridge regression. Without a bound, a joint that is fitted badly has a large noise and therefore a small
            weight, which keeps its fit bad.
    """

    jacobian: TorqueJacobian
    noise: torch.Tensor
    prior: ParameterPrior
    adapt: Adaptation | None
    compensated: torch.Tensor
    correlation_time: torch.Tensor
    max_error: torch.Tensor = UNBOUNDED

    @classmethod
    def of(
        cls,
        jacobian: TorqueJacobian,
        widths: GaussianPrior,
        adapt: Adaptation | None = None,
        max_error: torch.Tensor = UNBOUNDED,
    ) -> TorqueProblem:
        """Return the problem with the model's current parameters as the prior mean.

        widths: initial standard deviations of the prior. adapt: parameters to estimate: "load" (the last body),
        "friction" (friction and torque offsets), "unit" or None (all parameters). max_error: upper bound of the root
        mean square torque error, (n,) [Nm, N]. The initial noise is `NoiseEstimator.upper_bound`.
        """
        rigid = jacobian.rigid
        correlation_time = torch.full_like(jacobian.torque_std, TUNING.correlation_time)
        noise = NoiseEstimator.of(jacobian, correlation_time, max_error).upper_bound()
        prior = ParameterPrior.of(rigid, widths)
        compensated = rigid.initial[rigid.compensation] != 0
        return cls(jacobian, noise, prior, adapt, compensated, correlation_time, max_error)

    @cached_property
    def free(self) -> torch.Tensor:
        """Mask (K,), True for the parameters that are estimated."""
        return self.jacobian.rigid.free_mask(self.adapt, self.compensated)

    @cached_property
    def noise_estimator(self) -> NoiseEstimator:
        """Estimator of the torque noise; its samples are the samples for which ``jacobian`` was computed."""
        return NoiseEstimator.of(self.jacobian, self.correlation_time, self.max_error)

    @property
    def correlation_length(self) -> torch.Tensor:
        """Number of samples per independent error, (n,)."""
        return self.noise_estimator.correlation_length

    def with_least_squares_noise(self, x: torch.Tensor) -> TorqueProblem:
        """Return the problem with the noise that is estimated from the residual of unconstrained least squares.

        The torque is linearized at x (K,) and fitted by least squares in the inertial, drive and friction parameters,
        without a prior and without physical consistency of the bodies. The torque is linear in most of these
        parameters; velocity scales of friction are an exception. No x therefore has a much smaller residual, and this
        noise is approximately a lower bound. Noise that is estimated from the residual of a poor initial guess would be
        too large, and the fit would stop early.
        """
        estimator = self.noise_estimator
        noise, rows = estimator.upper_bound(), list(self.jacobian.joint_rows(x))
        # The least-squares solution depends on the weights 1 / noise^2 of the joints, since joints have common
        # parameters, and the weights depend on the solution. Two iterations suffice.
        for _ in range(2):
            noise = estimator.estimate(*least_squares_residual(rows, noise, self.free))
        return replace(self, noise=noise)

    def residual(self, x: torch.Tensor) -> torch.Tensor:
        """Return the sum of the squared torque residual over all samples at x (K,), per joint, (n,) [Nm^2, N^2]."""
        return self.jacobian.squared_residual(x)

    def cost(self, x: torch.Tensor, residual: torch.Tensor) -> float:
        """Return the negative log posterior of x (K,) up to a constant.

        residual: sum of the squared torque residual over all samples, per joint, (n,) [Nm^2, N^2].
        """
        deviation = x - self.prior.mean
        penalty = deviation @ self.prior.precision @ deviation
        return float(((residual / self.noise.square()).sum() + penalty) / 2)

    def normal_equations(self, x: torch.Tensor, residual: torch.Tensor) -> NormalEquations:
        """Return the Gauss-Newton Hessian (k, k) and negative gradient (k,) of the cost at x, for k free parameters.

        residual: squared residual per joint, (n,) [Nm^2, N^2], which is not used: the residual of each sample is
        computed here.
        """
        # The prior of factors that all joints share (see `prior_covariance`) couples free and fixed parameters: the
        # gradient of the free ones depends on the deviations of the fixed ones from their prior mean.
        curvature, descent = self.jacobian.normal_equations(x, self.noise)
        penalty_gradient = self.prior.precision @ (x - self.prior.mean)
        curvature = (curvature + self.prior.precision)[self.free][:, self.free]
        return NormalEquations(curvature, (descent - penalty_gradient)[self.free])

    def candidates(self, x: torch.Tensor, step: torch.Tensor) -> Iterator[torch.Tensor]:
        """Yield two candidates (K,) for the parameters after a step: x + step, and the end of a curve.

        The torque is less nonlinear along the curve than along x + step. The curve has the tangent `step` at x, and is
        a straight line in the inertial parameters of the bodies (see `TorqueJacobian.curved_step`). step: (k,), step of
        the k free parameters; the step of fixed parameters is zero.
        """
        change = torch.zeros_like(x).masked_scatter(self.free, step)
        # The candidate x + step needs less time and is as good near the optimum. Far from the optimum, the candidate
        # along a curve (`curved_step`) may have a lower cost.
        yield x + change
        yield self.jacobian.curved_step(x, change)

    def minimize(self, state: State, max_steps: int) -> SolverResult[torch.Tensor]:
        """Return the result of at most `max_steps` Levenberg-Marquardt steps from `state`.

        The cost of `state` is recomputed first, since its noise or prior may be different.
        """
        state = replace(state, cost=self.cost(state.x, state.residual))
        return levenberg_marquardt(
            self, state, max_steps=max_steps, min_relative_decrease=TUNING.min_relative_decrease
        )

    def covariance(self, precision: torch.Tensor) -> torch.Tensor:
        """Return the covariance (K, K) of all K parameters, which is zero for fixed parameters.

        precision: inverse covariance of the k free parameters, (k, k), for example the Gauss-Newton Hessian.
        """
        return self.of_all_parameters(torch.linalg.inv(precision))

    def of_all_parameters(self, free_covariance: torch.Tensor) -> torch.Tensor:
        """Return the covariance (K, K) of all parameters for a covariance of the free ones; other entries are zero.

        free_covariance: (k, k), covariance of the k free parameters.
        """
        covariance = torch.zeros_like(self.prior.precision)
        covariance[self.free[:, None] & self.free] = free_covariance.flatten()
        return covariance

    def updated(self, state: State, covariance: torch.Tensor) -> TorqueProblem:
        """Return the problem with noise and prior widths re-estimated at a state of the solver.

        The noise depends on the effective number of parameters, gamma = tr(1 - covariance P), with the precision P of
        the prior (MacKay, 1992). Each joint is assigned an equal share of gamma. covariance: (K, K), posterior
        covariance.
        """
        free, joints = self.free, len(state.residual)
        # The effective number of parameters, gamma, is computed for all joints together, since the torques of several
        # joints determine a parameter of a body.
        gamma = float(free.sum() - (covariance * self.prior.precision)[free][:, free].sum())
        noise = self.noise_estimator.estimate(state.residual, gamma / joints)
        # The prior width of the bodies cannot be estimated if only one body, the load, is fitted.
        prior = self.prior if self.adapt == "load" else update_widths(self.prior, state.x, covariance)
        return replace(self, noise=noise, prior=prior)


@dataclass(frozen=True, eq=False)
class TorqueEstimate:
    """MAP estimate: the problem with its noise and prior, and the last state of the solver.

    covariance: (K, K), posterior covariance of the K parameters. After `alternate`, it is the covariance for the noise
    and the prior before their last update; `with_current_covariance` recomputes it.
    """

    problem: TorqueProblem
    state: State
    covariance: torch.Tensor

    def with_jacobian(self, jacobian: TorqueJacobian) -> TorqueEstimate:
        """Return the estimate with the same parameters x and another Jacobian, for other samples or residual terms.

        The squared torque residual at x is recomputed with the new Jacobian, since it depends on the samples, the
        residual terms and the friction model of each joint (bristles, or rate-only friction:
        `FrictionLaws.memoryless`).
        """
        state = replace(self.state, residual=jacobian.squared_residual(self.state.x))
        return replace(self, problem=replace(self.problem, jacobian=jacobian), state=state)

    def with_current_covariance(self) -> TorqueEstimate:
        """Return the estimate with the covariance recomputed for the current noise and prior."""
        normal = self.problem.normal_equations(self.state.x, self.state.residual)
        return replace(self, covariance=self.problem.covariance(normal.curvature))

    def on_segments(self, samples: TorqueSamples) -> TorqueEstimate:
        """Return this estimate, converted to segments of consecutive samples.

        The estimate may have been fitted to a subset of the samples with gaps, from which the correlation time of the
        torque errors cannot be estimated. The segments have a duration of `TUNING.segment` and are cut from `samples`.
        The parameters x are unchanged; the noise is converted to the sample interval of the segments. Before
        the samples are replaced, the covariance is recomputed for the current noise.
        """
        jacobian = TorqueJacobian(
            self.problem.jacobian.model, samples.segments(TUNING.segment, TUNING.initial_samples)
        )
        segments = self.with_current_covariance().with_jacobian(jacobian)
        length = segments.problem.correlation_length
        # noise^2 is the mean squared residual times the correlation length, in samples (see `NoiseEstimator`). Only the
        # length depends on the sample interval, so the noise is multiplied by the square root of the ratio of the
        # lengths.
        noise = self.problem.noise * (length / self.problem.correlation_length).sqrt()
        return replace(segments, problem=replace(segments.problem, noise=noise))

    def linearize(self) -> tuple[ResidualSamples, RigidProjection]:
        """Return the torque residual at the estimate, and a `RigidProjection` for torques of residual terms.

        The projection computes the part of a joint torque that the rigid-body and friction model would absorb. The
        absorbed part is proportional to the posterior covariance divided by the noise variance. The covariance must be
        current (see `with_current_covariance`): `alternate` may have lowered the noise after computing it.
        """
        jacobian, x = self.problem.jacobian, self.state.x
        projection = jacobian.rigid_projection(x, self.problem.noise, self.covariance)
        return jacobian.residual_samples(x), projection


def alternate(problem: TorqueProblem, state: State) -> TorqueEstimate:
    """Alternate Levenberg-Marquardt steps with updates of noise and prior; return the MAP estimate.

    The iterations end when an update lowers the noise of no joint by more than a few per cent, and after
    `TUNING.iterations` at the latest. A noise that rises does not continue the iterations.

    Args:
        problem: problem with initial noise and prior.
        state: initial state of the solver.
    """
    for number in range(TUNING.iterations):
        result = problem.minimize(state, TUNING.iteration_steps)
        state, covariance = result.state, problem.covariance(result.normal_equations.curvature)
        previous, problem = problem, problem.updated(state, covariance)
        # Convergence is not tested after the first update, since the initial noise may have been estimated from other
        # samples or with another model.
        if number and (problem.noise > TUNING.noise_converged * previous.noise).all():
            break
    return TorqueEstimate(problem, state, covariance)


def refine(
    estimate: TorqueEstimate, samples: TorqueSamples, terms: Mapping[int, LinearTerms] = NO_TERMS
) -> TorqueEstimate:
    """Return the estimate for other samples, or with residual terms, refitted with ``estimate`` as the warm start.

    terms: {joint: residual terms}. Their torque is linear in their weights, which are eliminated by variable
    projection.
    """
    estimate = estimate.with_jacobian(TorqueJacobian(estimate.problem.jacobian.model, samples, terms))
    # The noise of ``estimate`` is not used, since it was estimated from other samples or with other linear terms.
    noise = estimate.problem.noise_estimator.estimate(estimate.state.residual)
    return alternate(replace(estimate.problem, noise=noise), estimate.state)


def with_correlation_time(estimate: TorqueEstimate, samples: TorqueSamples) -> TorqueEstimate:
    """Return the estimate with correlation times (n,) [s] of the torque errors that are estimated from samples.

    The torque error is a sum of two errors: filtered white noise, with a correlation time of 0.06 s, and the error of
    the model, with tenths of a second to seconds. The integrated correlation time of the sum is estimated on segments
    of samples, from the residual. Since fitted parameters reduce the correlation of the residual, the residual is
    corrected first (see `RigidProjection.errors`). The result is a weighted mean of this value and of the prior mean
    `TUNING.correlation_time`. The weight of the value is the number of independent errors in the segments, at the prior
    correlation time; the weight of the prior mean is a constant.

    The correlation time is estimated only once. Updates in the outer iterations would be unstable: a joint with a long
    correlation time has a small weight, so its residual grows, which makes the correlation time even longer.
    """
    segments, problem, prior_mean = estimate.on_segments(samples), estimate.problem, TUNING.correlation_time
    residual, projection = segments.linearize()
    interval, size = segments.problem.jacobian.samples.interval, samples.segment_length(TUNING.segment)
    errors = projection.errors(residual.torque_residual, size)
    observed = torch.from_numpy(correlation_time(list(errors.numpy()))) * interval
    # A weighted mean is formed. The weight of the prior mean is 1. The weight of the estimated correlation time is the
    # number of independent errors in the segments divided by `correlation_weight`, the number to which the prior mean
    # is equivalent.
    weight = len(residual.q) * interval / prior_mean / TUNING.correlation_weight
    mean = (weight * observed + prior_mean) / (weight + 1)
    noise = problem.noise * (mean / problem.correlation_time).sqrt()
    return replace(estimate, problem=replace(problem, noise=noise, correlation_time=mean))
