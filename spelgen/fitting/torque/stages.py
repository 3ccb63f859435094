"""Stages of a torque fit: initial fit, choice of the friction state, of friction effects, and of residual terms."""

from collections.abc import Sequence
from dataclasses import replace

import torch

from spelgen.fitting.levenberg_marquardt import initial_state
from spelgen.fitting.torque.jacobian import TorqueJacobian
from spelgen.fitting.torque.joint_functions import TermKey, refit_terms
from spelgen.fitting.torque.networks import select_networks
from spelgen.fitting.torque.parameters import NEGLIGIBLE
from spelgen.fitting.torque.problem import (
    State,
    TorqueEstimate,
    TorqueProblem,
    alternate,
    refine,
)
from spelgen.fitting.torque.samples import TorqueSamples
from spelgen.fitting.torque.selection import SelectedTerm, can_split, select_functions
from spelgen.fitting.torque.tuning import TUNING

EFFECT_GROUPS = ("effects", "load_dependence")
"""Groups of the Stribeck effect, saturation and load dependence of friction, which not every joint has."""


def initial_fit(problem: TorqueProblem) -> TorqueEstimate:
    """Fit all parameters from the prior mean.

    If the residual of some joints shows a friction compensation, the fit restarts with trained compensation at these
    joints, until no further joint shows one. Without restarts, other parameters would absorb the compensation, and the
    fit would not recover.
    """
    problem, state = _annealed_fit(problem, 0)
    while problem.adapt is None and (further := find_compensation(problem, state.x)).any():
        problem = replace(problem, compensated=problem.compensated | further)
        problem, state = _annealed_fit(problem, state.steps)
    estimate = alternate(problem, state)
    if problem.adapt is not None or estimate.problem.prior.plausible or problem.compensated.all():
        return estimate
    # The fitted masses differ implausibly from the URDF (`ParameterPrior.plausible`). More likely the drives compensate
    # friction, and the masses absorbed the compensation: refit with compensation at all joints.
    problem = replace(problem, compensated=torch.ones_like(problem.compensated))
    compensated = alternate(*_annealed_fit(problem, estimate.state.steps))
    return compensated if compensated.problem.prior.plausible else estimate


def _annealed_fit(problem: TorqueProblem, steps: int) -> tuple[TorqueProblem, State]:
    """Fit from the prior mean by noise annealing; steps: number of solver steps before this fit.

    Far from the optimum, the cost at the least-squares noise is a narrow curved valley, along which steps are small.
    Larger noise widens the valley and allows larger steps. The noise starts at a fraction of the torque residual, and
    falls with the residual to the least-squares noise.
    """
    estimator, mean = problem.noise_estimator, problem.prior.mean
    problem = problem.with_least_squares_noise(mean)
    min_noise = problem.noise
    state = initial_state(problem, mean, steps=steps)
    for _ in range(TUNING.annealing_iterations):
        problem = replace(problem, noise=torch.maximum(min_noise, estimator.annealed(state.residual)))
        if (problem.noise == min_noise).all():
            break
        state = problem.minimize(state, TUNING.iteration_steps).state
    return _least_squares_noise_fit(problem, state)


def _least_squares_noise_fit(problem: TorqueProblem, state: State) -> tuple[TorqueProblem, State]:
    """Fit from a state, with the noise of unconstrained least squares linearized at this state."""
    problem = problem.with_least_squares_noise(state.x)
    state = initial_state(problem, state.x, steps=state.steps)
    return problem, problem.minimize(state, TUNING.initial_steps).state


def find_compensation(problem: TorqueProblem, x: torch.Tensor) -> torch.Tensor:
    """Return the joints (n,) whose residual at x (K,) shows a friction compensation that is not modelled yet.

    Friction cannot explain a torque that decreases with velocity. A drive that compensates friction after the torque
    was measured adds such a torque. The residual is regressed on velocity; the slope must be negative and significant.
    Both are first regressed on position: the torque of a spring is correlated with velocity in a motion that does not
    return to its first position. The torque of the regression line must also be a visible part of the measured torque,
    since a delay of some milliseconds between torque and motion causes a smaller negative slope. The drives of an arm
    are similar: if one of them compensates friction, a negative slope of more than one standard deviation, without the
    regression on position, suffices for the others, whose parameters may have absorbed a part of the compensation.
    """
    samples = problem.jacobian.residual_samples(x)
    residual, qd, estimator = samples.torque_residual, samples.qd, problem.noise_estimator
    first = not problem.compensated.any()
    if first:
        residual, qd = _without_line(residual, samples.q), _without_line(qd, samples.q)
    products = (residual * qd).sum(dim=0)
    slope = products / qd.square().sum(dim=0).clamp(min=1e-300)
    # `explained` is the coefficient of determination: the fraction of the squared residual that the regression line
    # explains.
    explained = slope * products / residual.square().sum(dim=0).clamp(min=1e-300)
    # `deviations` is the t statistic of the slope: the slope divided by its standard deviation.
    deviations = (explained * estimator.errors / (1 - explained)).sqrt()
    decreasing = (slope < 0) & (deviations > 1) & ~problem.compensated
    if not first:
        return decreasing
    amplitude = (slope * products / estimator.count).sqrt()
    visible = amplitude > TUNING.min_compensation * estimator.torque_std
    return decreasing & (deviations > TUNING.min_significance) & visible


def _without_line(values: torch.Tensor, q: torch.Tensor) -> torch.Tensor:
    """Return the residual of the regression of values (T, n) on a constant and the position q (T, n) of each joint."""
    values, q = values - values.mean(dim=0), q - q.mean(dim=0)
    return values - q * ((q * values).sum(dim=0) / q.square().sum(dim=0).clamp(min=1e-300))


def choose_friction_state(estimate: TorqueEstimate) -> TorqueEstimate:
    """Choose per joint between rate-only friction, which the given estimate has, and friction with bristle states.

    The force of bristles reverses over a displacement, hence later than the velocity. At joints whose friction reverses
    with the velocity, the delayed force would be confounded with inertia. The choice is by the evidence (see
    `_rejected`).
    """
    friction = estimate.problem.jacobian.model.friction
    friction.memoryless.fill_(0.0)
    # Bristles explain more than rate-only friction, so the noise is estimated again.
    problem, state = _least_squares_noise_fit(estimate.problem, estimate.state)
    hysteretic = alternate(problem, state)
    evidence = log_likelihood_ratio(hysteretic, estimate) - fraction_occam_factor(hysteretic)
    rate_only = _rejected(evidence)
    friction.memoryless.copy_(rate_only)
    if rate_only.all():
        return estimate
    if rate_only.any():
        # The friction model of some joints has changed, so the residual is recomputed.
        mixed = hysteretic.with_jacobian(hysteretic.problem.jacobian)
        return alternate(mixed.problem, mixed.state)
    return hysteretic


def choose_friction_effects(estimate: TorqueEstimate) -> TorqueEstimate:
    """Choose the joints with Stribeck effect, saturation and load dependence of friction.

    The coefficients of these effects are constrained to be positive, so noise biases all of them upwards. The effects
    are removed at joints where they do not improve the likelihood enough for one additional parameter.
    """
    rigid = estimate.problem.jacobian.rigid
    index = rigid.unflatten(torch.arange(len(estimate.state.x)))
    effects = torch.stack(
        [index[name] for name in rigid.names(*EFFECT_GROUPS)], dim=-1
    )  # (n, effects): indices in x
    plain = _without(estimate, effects.flatten())
    # penalty of Akaike's criterion for one parameter (IEEE Trans. Autom. Control 19:716, 1974)
    rejected = _rejected(log_likelihood_ratio(estimate, plain) - 2)
    if rejected.all():
        return plain
    return _without(estimate, effects[rejected].flatten()) if rejected.any() else estimate


def _without(estimate: TorqueEstimate, indices: torch.Tensor) -> TorqueEstimate:
    """Refit with negligible friction coefficients at the given indices (k,) of x."""
    problem, x, mean = estimate.problem, estimate.state.x.clone(), estimate.problem.prior.mean.clone()
    # The prior mean is changed, too: otherwise the prior would restore the coefficients.
    mean[indices] = x[indices] = NEGLIGIBLE
    problem = replace(problem, prior=replace(problem.prior, mean=mean))
    state = replace(estimate.state, x=x, residual=problem.residual(x))
    return alternate(problem, state)


def log_likelihood_ratio(estimate: TorqueEstimate, other: TorqueEstimate) -> torch.Tensor:
    """Return 2 log(L(estimate) / L(other)) per joint, (n,), each likelihood L at its maximum-likelihood noise.

    Positive values favour `estimate`.
    """
    samples = estimate.problem.jacobian.samples
    # At the maximum-likelihood noise of each estimate, the result is the number of independent errors times the log
    # of the ratio of squared residuals.
    errors = samples.count * min(1.0, samples.interval / TUNING.reversal_correlation_time)
    return errors * (other.state.residual / estimate.state.residual).log()


def fraction_occam_factor(estimate: TorqueEstimate) -> torch.Tensor:
    """Return -2 log(Occam factor) of the bristle fractions per joint, (n,).

    The value is log det of their prior covariance minus log det of their posterior covariance (MacKay, 1992). The
    evidence of a model is its likelihood times the Occam factor, which accounts for the noise that free parameters
    explain.
    """
    rigid = estimate.problem.jacobian.rigid
    (name,) = rigid.names("fractions")
    fractions = rigid.unflatten(torch.arange(len(estimate.state.x)))[name]  # (n, elements): indices in x
    block = fractions.unsqueeze(-1), fractions.unsqueeze(-2)
    prior: torch.Tensor = torch.linalg.inv(estimate.problem.prior.precision)[block]
    return prior.logdet() - estimate.covariance[block].logdet()


def _rejected(evidence: torch.Tensor) -> torch.Tensor:
    """Return the joints (n,) at which a model is rejected; evidence: twice the log evidence for the model, (n,).

    The gears of an arm have similar friction, so joints with weak evidence use the sum over all joints. If the sum
    favours the model, it is rejected only at joints with strong evidence against it. Otherwise it is rejected at all
    joints without strong evidence for it.
    """
    return evidence < -TUNING.strong_evidence * evidence.sum().sign()


def fit_residual_terms(
    estimate: TorqueEstimate, samples: TorqueSamples
) -> tuple[TorqueEstimate, list[SelectedTerm]]:
    """Select residual terms on samples, and fit them together with the rigid-body parameters.

    Single-joint terms are selected first, in passes. Each pass is followed by a refit of the rigid-body parameters,
    which improves the residual for the selection of further terms. Networks, which act on several joints, are selected
    last, on the residual of the model with the selected single-joint terms.
    """
    model = estimate.problem.jacobian.model
    if samples is not estimate.problem.jacobian.samples:
        estimate = refine(estimate, samples)
    estimate.problem.jacobian.rigid.write(estimate.state.x)
    correlation_length = estimate.problem.correlation_length
    if not can_split(samples.count, float(correlation_length.max())):
        return estimate, []
    selected: list[SelectedTerm] = []
    estimate = estimate.with_current_covariance()
    data = correlation_length, samples.recordings, estimate.problem.jacobian.torque_std
    while further := select_functions(model, *estimate.linearize(), _keys(selected), *data):
        selected += further
        estimate = _refit(estimate, samples, selected).with_current_covariance()
    residual_samples = estimate.problem.jacobian.residual_samples(estimate.state.x)
    selected += select_networks(model, residual_samples, float(correlation_length.max()))
    # Friction factors and networks are not eliminated by variable projection: alternate with the rigid-body fit.
    for _ in range(TUNING.alternations if selected else 0):
        estimate = _refit(estimate.with_current_covariance(), samples, selected)
    return estimate, selected


def _refit(
    estimate: TorqueEstimate, samples: TorqueSamples, selected: Sequence[SelectedTerm]
) -> TorqueEstimate:
    """Refit the selected single-joint terms, then rigid-body parameters and position-dependent torques together."""
    model, correlation_length = estimate.problem.jacobian.model, estimate.problem.correlation_length
    projected = refit_terms(model, *estimate.linearize(), _keys(selected), correlation_length)
    estimate = refine(estimate, samples, projected.terms)
    jacobian, x = estimate.problem.jacobian, estimate.state.x
    jacobian.rigid.write(x)
    projected.write(model, jacobian.residual_samples(x).torque_residual)
    return estimate.with_jacobian(TorqueJacobian(model, samples))


def _keys(terms: Sequence[SelectedTerm]) -> set[TermKey]:
    return {(term.name, term.joint) for term in terms}
