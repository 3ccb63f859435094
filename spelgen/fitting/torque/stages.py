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

    The fit restarts with a friction compensation for all joints whose residual shows one, until no further joint does:
    without it other parameters absorb the compensation, from which the fit would not recover.
    """
    problem, state = _annealed_fit(problem, 0)
    while problem.adapt is None and (further := find_compensation(problem, state.x)).any():
        problem = replace(problem, compensated=problem.compensated | further)
        problem, state = _annealed_fit(problem, state.steps)
    estimate = alternate(problem, state)
    if problem.adapt is not None or estimate.problem.prior.plausible or problem.compensated.all():
        return estimate
    # masses that are wrong by such a factor are less plausible than drives that compensate friction, whose torque the
    # masses absorb
    problem = replace(problem, compensated=torch.ones_like(problem.compensated))
    compensated = alternate(*_annealed_fit(problem, estimate.state.steps))
    return compensated if compensated.problem.prior.plausible else estimate


def _annealed_fit(problem: TorqueProblem, steps: int) -> tuple[TorqueProblem, State]:
    """Return the fit from the prior mean by noise annealing; steps: taken before.

    At the noise of least squares the cost is a narrow curved valley far from the optimum. Noise annealing follows it
    with larger steps: start from a fraction of the current residual, and lower the noise with it to the least-squares
    level.
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
    """Return the fit from a state under the noise of least squares, linearized there."""
    problem = problem.with_least_squares_noise(state.x)
    state = initial_state(problem, state.x, steps=state.steps)
    return problem, problem.minimize(state, TUNING.initial_steps).state


def find_compensation(problem: TorqueProblem, x: torch.Tensor) -> torch.Tensor:
    """Return the joints (n,) whose residual at x (K,) shows a friction compensation that is not modelled yet.

    No friction model explains a torque that decreases with velocity. A drive that compensates friction after its torque
    was measured adds such a torque. The slope of the residual over velocity must be negative, significant, explain a
    part of the squared residual, and be visible in the torque: a delay of some milliseconds between torque and motion
    causes a negative slope, too, but a smaller one. The drives of an arm are similar: if one compensates friction, a
    slope of more than one standard deviation suffices for the others, whose parameters may absorb the compensation.
    """
    samples = problem.jacobian.residual_samples(x)
    residual, estimator = samples.torque_residual, problem.noise_estimator
    products = (residual * samples.qd).sum(dim=0)
    slope = products / samples.qd.square().sum(dim=0).clamp(min=1e-300)
    # share of the squared residual that the regression line explains (coefficient of determination)
    explained = slope * products / residual.square().sum(dim=0).clamp(min=1e-300)
    # standard deviations by which the slope differs from zero
    deviations = (explained * estimator.errors / (1 - explained)).sqrt()
    decreasing = (slope < 0) & (deviations > 1) & ~problem.compensated
    if problem.compensated.any():
        return decreasing
    amplitude = (slope * products / estimator.count).sqrt()
    visible = amplitude > TUNING.min_compensation * estimator.torque_std
    return decreasing & (deviations > TUNING.min_significance) & visible


def choose_friction_state(estimate: TorqueEstimate) -> TorqueEstimate:
    """Choose per joint between rate-only friction, of the given estimate, and friction with bristle states.

    Bristles reverse their force over a displacement, and so after velocity reverses: at joints whose friction reverses
    at once they would be confounded with inertia. The choice is by evidence (see `_rejected`).
    """
    friction = estimate.problem.jacobian.model.friction
    friction.memoryless.fill_(0.0)
    # the noise of rate-only friction is too large for bristles, which explain more
    problem, state = _least_squares_noise_fit(estimate.problem, estimate.state)
    hysteretic = alternate(problem, state)
    evidence = log_likelihood_ratio(hysteretic, estimate) - fraction_occam_factor(hysteretic)
    rate_only = _rejected(evidence)
    friction.memoryless.copy_(rate_only)
    if rate_only.all():
        return estimate
    if rate_only.any():
        # the friction state changed in the model: the residual is recomputed
        mixed = hysteretic.with_jacobian(hysteretic.problem.jacobian)
        return alternate(mixed.problem, mixed.state)
    return hysteretic


def choose_friction_effects(estimate: TorqueEstimate) -> TorqueEstimate:
    """Choose the joints with Stribeck effect, saturation and load dependence of friction.

    These coefficients are constrained to be positive, so noise biases all of them upwards: they are removed at joints
    where they do not improve the likelihood by more than their number accounts for.
    """
    rigid = estimate.problem.jacobian.rigid
    index = rigid.unflatten(torch.arange(len(estimate.state.x)))
    effects = torch.stack([index[name] for name in rigid.names(*EFFECT_GROUPS)], dim=-1)  # (n, effects)
    plain = _without(estimate, effects.flatten())
    # Akaike's criterion, for one parameter (IEEE Trans. Autom. Control 19:716, 1974)
    rejected = _rejected(log_likelihood_ratio(estimate, plain) - 2)
    if rejected.all():
        return plain
    return _without(estimate, effects[rejected].flatten()) if rejected.any() else estimate


def _without(estimate: TorqueEstimate, indices: torch.Tensor) -> TorqueEstimate:
    """Return the estimate with negligible coefficients, in x and in the prior mean, at these indices (k,)."""
    problem, x, mean = estimate.problem, estimate.state.x.clone(), estimate.problem.prior.mean.clone()
    # in the prior mean, too: otherwise the prior would restore them
    mean[indices] = x[indices] = NEGLIGIBLE
    problem = replace(problem, prior=replace(problem.prior, mean=mean))
    state = replace(estimate.state, x=x, residual=problem.residual(x))
    return alternate(problem, state)


def log_likelihood_ratio(estimate: TorqueEstimate, other: TorqueEstimate) -> torch.Tensor:
    """Return twice the log likelihood ratio of two estimates per joint (n,), with the noise maximized out."""
    samples = estimate.problem.jacobian.samples
    # the noise maximized out: log of the ratio of squares, per independent error
    errors = samples.count * min(1.0, samples.interval / TUNING.reversal_correlation_time)
    return errors * (other.state.residual / estimate.state.residual).log()


def fraction_occam_factor(estimate: TorqueEstimate) -> torch.Tensor:
    """Return the Occam factor of the bristle fractions per joint (n,), twice its negative logarithm.

    It is log det of their prior covariance minus log det of their posterior covariance (MacKay, 1992). The evidence of
    a model is its likelihood times this factor: free parameters explain noise, too.
    """
    rigid = estimate.problem.jacobian.rigid
    (name,) = rigid.names("fractions")
    fractions = rigid.unflatten(torch.arange(len(estimate.state.x)))[name]  # (n, elements)
    block = fractions.unsqueeze(-1), fractions.unsqueeze(-2)
    prior: torch.Tensor = torch.linalg.inv(estimate.problem.prior.precision)[block]
    return prior.logdet() - estimate.covariance[block].logdet()


def _rejected(evidence: torch.Tensor) -> torch.Tensor:
    """Return the joints (n,) at which a model is rejected, given twice the log evidence for it per joint (n,).

    The friction of an arm's gears is similar: weak evidence of a joint yields to the sum over all joints. Rejected are
    joints with strong evidence against the model if the sum is in favour, and joints without strong evidence for it
    otherwise.
    """
    return evidence < -TUNING.strong_evidence * evidence.sum().sign()


def fit_residual_terms(
    estimate: TorqueEstimate, samples: TorqueSamples
) -> tuple[TorqueEstimate, list[SelectedTerm]]:
    """Select residual terms on samples, and fit them together with the rigid-body parameters.

    Single-joint terms are selected first, in passes: each pass improves the rigid-body parameters, and with them the
    residual on which further terms are selected. Networks of several joints are selected on the residual after these
    terms.
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
    # friction factors and networks are not eliminated, so that alternations are needed
    for _ in range(TUNING.alternations if selected else 0):
        estimate = _refit(estimate.with_current_covariance(), samples, selected)
    return estimate, selected


def _refit(
    estimate: TorqueEstimate, samples: TorqueSamples, selected: Sequence[SelectedTerm]
) -> TorqueEstimate:
    """Refit the selected single-joint terms and the rigid-body parameters, with torques of position eliminated."""
    model, correlation_length = estimate.problem.jacobian.model, estimate.problem.correlation_length
    projected = refit_terms(model, *estimate.linearize(), _keys(selected), correlation_length)
    estimate = refine(estimate, samples, projected.terms)
    jacobian, x = estimate.problem.jacobian, estimate.state.x
    jacobian.rigid.write(x)
    projected.write(model, jacobian.residual_samples(x).torque_residual)
    return estimate.with_jacobian(TorqueJacobian(model, samples))


def _keys(terms: Sequence[SelectedTerm]) -> set[TermKey]:
    return {(term.name, term.joint) for term in terms}
