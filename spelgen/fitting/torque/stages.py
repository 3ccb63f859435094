"""Stages of a torque fit: initial fit, choice of the friction state, of friction effects, and of residual terms."""

from collections.abc import Sequence
from dataclasses import replace

import torch

from spelgen.fitting.levenberg_marquardt import initial_state
from spelgen.fitting.torque.jacobian import TorqueJacobian
from spelgen.fitting.torque.joint_functions import TermKey, refit_terms
from spelgen.fitting.torque.networks import select_networks
from spelgen.fitting.torque.parameters import MIN_SPEED, NEGLIGIBLE
from spelgen.fitting.torque.problem import State, TorqueEstimate, TorqueProblem, alternate, refine
from spelgen.fitting.torque.samples import TorqueSamples
from spelgen.fitting.torque.selection import (
    SelectedTerm,
    block_squares,
    can_split,
    select_functions,
    significant_reduction,
)
from spelgen.fitting.torque.tuning import TUNING


def initial_fit(problem: TorqueProblem) -> TorqueEstimate:
    """Fit the free parameters from the prior mean; return the MAP estimate.

    If the torque residual of some joints shows a friction compensation of the drive, the fit is restarted with trained
    compensation at these joints, until no further joint shows one. Without a restart, the other parameters would remain
    at values that have absorbed the compensation.
    """
    problem, state = _annealed_fit(problem, 0)
    while problem.adapt is None and (further := find_compensation(problem, state.x)).any():
        problem = replace(problem, compensated=problem.compensated | further)
        problem, state = _annealed_fit(problem, state.steps)
    estimate = alternate(problem, state)
    if problem.adapt is not None or estimate.problem.prior.plausible or problem.compensated.all():
        return estimate
    # Here the fitted masses differ implausibly from the URDF (see `ParameterPrior.plausible`). A probable reason is
    # that the drives compensate friction and the masses absorbed the compensation. The fit is repeated with
    # compensation at all joints, and kept if it is plausible.
    problem = replace(problem, compensated=torch.ones_like(problem.compensated))
    compensated = alternate(*_annealed_fit(problem, estimate.state.steps))
    return compensated if compensated.problem.prior.plausible else estimate


def _annealed_fit(problem: TorqueProblem, steps: int) -> tuple[TorqueProblem, State]:
    """Fit from the prior mean by noise annealing; return the problem and the last state of the solver.

    With the small noise of least squares, the cost far from the optimum is a narrow curved valley, along which steps
    are small. Larger noise widens the valley and allows larger steps. Therefore the noise of each iteration is a
    fraction of the current torque residual, but at least the least-squares noise. steps: number of solver steps before
    this fit.
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
    """Fit from a state with the least-squares noise at this state (see `TorqueProblem.with_least_squares_noise`).

    Return the problem with this noise, and the last state of the solver.
    """
    problem = problem.with_least_squares_noise(state.x)
    state = initial_state(problem, state.x, steps=state.steps)
    return problem, problem.minimize(state, TUNING.initial_steps).state


def find_compensation(problem: TorqueProblem, x: torch.Tensor) -> torch.Tensor:
    """Return a mask (n,), True if the residual at x shows a friction compensation of the joint that is not modelled.

    A drive may compensate friction with a torque that the measured torque does not contain. The residual then decreases
    with velocity, which friction cannot explain. Criteria for a joint:

    - The slope of a regression of the residual on velocity is negative and significant. Linear functions of position
      are first removed from both: in a motion that does not return to its first position, the torque of a spring is
      correlated with velocity.
    - The torque of the regression line exceeds a fraction of the measured torque (`TUNING.min_compensation`): a delay
      of some milliseconds between torque and motion causes a smaller negative slope.

    The drives of an arm are similar. If one of them is known to compensate friction, the others probably do, too, and
    their parameters may have absorbed a part of the compensation. For the others, a negative slope of more than one
    standard deviation suffices, without the regression on position.
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
    # `deviations` is |slope| divided by the standard deviation of the slope: the t statistic of the regression on
    # velocity.
    deviations = (explained * estimator.errors / (1 - explained)).sqrt()
    # the velocity of a joint at rest is noise
    is_moving = samples.qd.abs().amax(dim=0) > MIN_SPEED
    decreasing = (slope < 0) & (deviations > 1) & is_moving & ~problem.compensated
    if not first:
        return decreasing
    amplitude = (slope * products / estimator.count).sqrt()
    visible = amplitude > TUNING.min_compensation * estimator.torque_std
    return decreasing & (deviations > TUNING.min_significance) & visible


def _without_line(values: torch.Tensor, q: torch.Tensor) -> torch.Tensor:
    """Return values (T, n) minus their regression on a constant and q (T, n), separately for each column."""
    values, q = values - values.mean(dim=0), q - q.mean(dim=0)
    return values - q * ((q * values).sum(dim=0) / q.square().sum(dim=0).clamp(min=1e-300))


def choose_friction_state(estimate: TorqueEstimate) -> TorqueEstimate:
    """Choose per joint between rate-only friction and friction with bristle states; return the new estimate.

    ``estimate`` has rate-only friction, which reverses with the velocity. The force of bristles reverses later, after a
    displacement. If bristles are fitted to a joint with rate-only friction, wrong inertias compensate this delay. The
    evidence of a joint is 2 log(L with bristles / L without bristles), with the marginal likelihood L of its torque.

    The joints with bristles are chosen by `_rejected`.
    """
    friction = estimate.problem.jacobian.model.friction
    residual = _torque_residual(estimate)
    friction.memoryless.fill_(0.0)
    # The noise is estimated again, since bristles explain more of the torque than rate-only friction does.
    problem, state = _least_squares_noise_fit(estimate.problem, estimate.state)
    hysteretic = alternate(problem, state)
    evidence = log_likelihood_ratio(hysteretic, estimate) - fraction_occam_factor(hysteretic)
    rate_only = _rejected(evidence, _torque_residual(hysteretic), residual)
    friction.memoryless.copy_(rate_only)
    if rate_only.all():
        return estimate
    if rate_only.any():
        # The friction model of some joints has changed, so the residual is recomputed.
        mixed = hysteretic.with_jacobian(hysteretic.problem.jacobian)
        return alternate(mixed.problem, mixed.state)
    return hysteretic


def _smaller_in_most_blocks(residual: torch.Tensor, reference: torch.Tensor) -> torch.Tensor:
    """Return a mask (n,), True for joints at which a torque residual is significantly smaller than a reference.

    The residuals are compared on ten blocks of samples (see `significant_reduction`). residual, reference: (T, n)
    [Nm, N].
    """
    return torch.tensor([
        significant_reduction(block_squares(larger), block_squares(smaller)) is not None
        for larger, smaller in zip(reference.mT, residual.mT, strict=True)
    ])  # fmt: skip


def choose_friction_effects(estimate: TorqueEstimate) -> TorqueEstimate:
    """Choose the joints with Stribeck effect, saturation and load dependence of friction; return the new estimate.

    The coefficients of these effects are constrained to be positive, so noise biases all of them upwards. The evidence
    of a joint for its effects is therefore 2 log(likelihood ratio) minus 2, Akaike's penalty for one parameter.

    - Saturation is tested first, and removed at all joints if the sum of their evidence is negative. The evidence of
      each joint is limited to +-`TUNING.strong_evidence`, so that no single joint decides: at a joint with very strong
      evidence, saturation may explain another error of the model, and would then be wrong at other speeds.
    - Then all effects of a joint are tested together (`_rejected`).
    """
    # Penalty of Akaike's criterion for one parameter (IEEE Trans. Autom. Control 19:716, 1974).
    penalty, limit = 2.0, TUNING.strong_evidence
    rigid = estimate.problem.jacobian.rigid
    index = rigid.unflatten(torch.arange(len(estimate.state.x)))
    unsaturated = _without(estimate, index["friction.raw_saturation"])
    evidence = log_likelihood_ratio(estimate, unsaturated) - penalty
    if evidence.clamp(-limit, limit).sum() < 0:
        estimate = unsaturated
    # `effects`: row k contains the indices in x of the coefficients of joint k, one per effect.
    effects = torch.stack([index[name] for name in rigid.names("effects", "load_dependence")], dim=-1)
    plain = _without(estimate, effects.flatten())
    evidence = log_likelihood_ratio(estimate, plain) - penalty
    rejected = _rejected(evidence, _torque_residual(estimate), _torque_residual(plain))
    if rejected.all():
        return plain
    return _without(estimate, effects[rejected].flatten()) if rejected.any() else estimate


def _without(estimate: TorqueEstimate, indices: torch.Tensor) -> TorqueEstimate:
    """Refit all parameters without some friction coefficients; return the new estimate.

    indices: indices of these coefficients in x (K,). The coefficients are logarithms. Their initial values and prior
    means become `NEGLIGIBLE`.
    """
    problem, x, mean = estimate.problem, estimate.state.x.clone(), estimate.problem.prior.mean.clone()
    # The prior mean of the removed coefficients is changed, too: otherwise the prior would restore the coefficients.
    mean[indices] = x[indices] = NEGLIGIBLE
    problem = replace(problem, prior=replace(problem.prior, mean=mean))
    state = replace(estimate.state, x=x, residual=problem.residual(x))
    return alternate(problem, state)


def log_likelihood_ratio(estimate: TorqueEstimate, other: TorqueEstimate) -> torch.Tensor:
    """Return 2 log(L(estimate) / L(other)) of each joint, (n,), with the likelihood L of the joint's torque.

    Each likelihood is computed with the noise that maximizes it. Positive values favour `estimate`.
    """
    samples = estimate.problem.jacobian.samples
    # With the noise that maximizes each likelihood, the likelihood ratio depends only on the squared residuals and on
    # the number of independent errors.
    errors = samples.count * min(1.0, samples.interval / TUNING.reversal_correlation_time)
    return errors * (other.state.residual / estimate.state.residual).log()


def fraction_occam_factor(estimate: TorqueEstimate) -> torch.Tensor:
    """Return -2 log(Occam factor) of each joint's bristle fractions (the parts of dry friction per bristle), (n,).

    The marginal likelihood of a model is its likelihood times the Occam factor, which accounts for the noise that free
    parameters explain (MacKay, 1992). The result is log det of the prior covariance of the fractions minus log det of
    their posterior covariance.
    """
    rigid = estimate.problem.jacobian.rigid
    (name,) = rigid.names("fractions")
    # fractions: (n, K), indices in x of the K bristle fractions of each joint
    fractions = rigid.unflatten(torch.arange(len(estimate.state.x)))[name]
    block = fractions.unsqueeze(-1), fractions.unsqueeze(-2)
    prior: torch.Tensor = torch.linalg.inv(estimate.problem.prior.precision)[block]
    return prior.logdet() - estimate.covariance[block].logdet()


def _torque_residual(estimate: TorqueEstimate) -> torch.Tensor:
    """Return the torque residual of an estimate at its samples, (T, n) [Nm, N]."""
    return estimate.problem.jacobian.residual_samples(estimate.state.x).torque_residual


def _rejected(evidence: torch.Tensor, residual: torch.Tensor, simple_residual: torch.Tensor) -> torch.Tensor:
    """Return a mask (n,), True for joints at which a model of friction is rejected in favour of a simpler one.

    If the sum of the evidence over all joints favours the model, it is rejected only at joints with strong evidence
    against it. Otherwise it is rejected at all joints without strong evidence for it: the gears of an arm have similar
    friction, so the sum decides at joints with weak evidence. Correlated errors make the evidence of a single joint
    unreliable. Strong evidence therefore counts only if the torque residual of the favoured model is significantly
    smaller, too (t test on ten blocks of the log).

    Args:
        evidence: (n,), twice the log of the likelihood ratio; positive values favour the model.
        residual: (T, n) torque residual of the model [Nm, N].
        simple_residual: (T, n) torque residual of the simpler model [Nm, N].
    """
    if evidence.sum() > 0:
        against = evidence < -TUNING.strong_evidence
        return against & _smaller_in_most_blocks(simple_residual, residual)
    return ~((evidence > TUNING.strong_evidence) & _smaller_in_most_blocks(residual, simple_residual))


def fit_residual_terms(
    estimate: TorqueEstimate, samples: TorqueSamples
) -> tuple[TorqueEstimate, list[SelectedTerm]]:
    """Select residual terms on samples, and fit them together with the rigid-body parameters.

    Single-joint terms are selected first, in passes. After each pass, the rigid-body parameters are refitted, so that
    further terms are selected on a better residual. Networks act on several joints and are selected last, on the
    residual of the model with the selected single-joint terms. Return the new estimate and the selected terms.
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
    # Friction factors and networks are not eliminated by variable projection. The fits of these terms and the
    # rigid-body fit are therefore alternated.
    for _ in range(TUNING.alternations if selected else 0):
        estimate = _refit(estimate.with_current_covariance(), samples, selected)
    return estimate, selected


def _refit(
    estimate: TorqueEstimate, samples: TorqueSamples, selected: Sequence[SelectedTerm]
) -> TorqueEstimate:
    """Refit the selected residual terms and the rigid-body parameters; return the new estimate.

    Position-dependent friction factors are fitted first, then position-dependent torques and rigid bodies together.
    """
    model, correlation_length = estimate.problem.jacobian.model, estimate.problem.correlation_length
    projected = refit_terms(model, *estimate.linearize(), _keys(selected), correlation_length)
    estimate = refine(estimate, samples, projected.terms)
    jacobian, x = estimate.problem.jacobian, estimate.state.x
    jacobian.rigid.write(x)
    projected.write(model, jacobian.residual_samples(x).torque_residual)
    return estimate.with_jacobian(TorqueJacobian(model, samples))


def _keys(terms: Sequence[SelectedTerm]) -> set[TermKey]:
    return {(term.name, term.joint) for term in terms}
