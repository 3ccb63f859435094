"""Stage of a torque fit that selects residual terms and fits them together with the rigid-body parameters."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import replace

import torch

from spelgen.fitting.torque.jacobian import TorqueJacobian
from spelgen.fitting.torque.joint_functions import TermKey, clear_terms, refit_terms
from spelgen.fitting.torque.network_selection import select_networks
from spelgen.fitting.torque.problem import TorqueEstimate, refine
from spelgen.fitting.torque.samples import TorqueSamples
from spelgen.fitting.torque.selection import (
    SelectedTerm,
    can_split,
    select_functions,
    split_halves,
    within_range,
)
from spelgen.fitting.torque.tuning import TUNING


def fit_residual_terms(
    estimate: TorqueEstimate, samples: TorqueSamples
) -> tuple[TorqueEstimate, list[SelectedTerm]]:
    """Select residual terms on samples, and fit them together with the rigid-body parameters.

    Single-joint terms are selected first, in passes: each pass improves the rigid-body parameters, and with them the
    residual on which further terms are selected. Networks of several joints are selected on the residual of these.
    """
    model = estimate.problem.jacobian.model
    if samples is not estimate.problem.jacobian.samples:
        estimate = refine(estimate, samples)
    estimate.problem.jacobian.rigid.write(estimate.state.x)
    correlation_length = estimate.problem.selection_correlation_length
    if not can_split(samples.count, correlation_length):
        return estimate, []
    rigid_only = estimate
    selected: list[SelectedTerm] = []
    estimate = estimate.with_current_covariance()
    while further := select_functions(model, *estimate.linearize(), _keys(selected), correlation_length):
        selected += further
        estimate = _refit(estimate, samples, selected).with_current_covariance()
    if selected:
        estimate, selected = _without_losing_joints(rigid_only, estimate, selected)
    residual_samples = estimate.problem.jacobian.residual_samples(estimate.state.x)
    selected += select_networks(model, residual_samples, correlation_length)
    for _ in range(TUNING.alternations if selected else 0):
        estimate = _refit(estimate.with_current_covariance(), samples, selected)
    return estimate, selected


def _refit(
    estimate: TorqueEstimate, samples: TorqueSamples, selected: Sequence[SelectedTerm]
) -> TorqueEstimate:
    """Refit the selected single-joint terms and the rigid-body parameters, with torques of position eliminated."""
    model, correlation_length = estimate.problem.jacobian.model, estimate.problem.selection_correlation_length
    projected = refit_terms(model, *estimate.linearize(), _keys(selected), correlation_length)
    estimate = refine(estimate, samples, projected.terms)
    jacobian, x = estimate.problem.jacobian, estimate.state.x
    jacobian.rigid.write(x)
    projected.write(model, jacobian.residual_samples(x).torque_residual)
    return estimate.with_jacobian(TorqueJacobian(model, samples))


def _without_losing_joints(
    rigid_only: TorqueEstimate, estimate: TorqueEstimate, selected: Sequence[SelectedTerm]
) -> tuple[TorqueEstimate, list[SelectedTerm]]:
    """Return estimate and terms without the terms of joints at which they do not lower the held-out error.

    rigid_only: estimate without terms.
    """
    jacobian = estimate.problem.jacobian
    model, samples = jacobian.model, jacobian.samples
    losing = _losing_joints(rigid_only, estimate, selected)
    kept = [term for term in selected if term.joint not in losing]
    clear_terms(model, losing)
    if not kept:
        estimate = rigid_only
    # the fits to half of the samples changed the model, whose armature bounds the networks of M
    jacobian.rigid.write(estimate.state.x)
    return estimate.with_jacobian(TorqueJacobian(model, samples)), kept


def _losing_joints(
    rigid_only: TorqueEstimate, estimate: TorqueEstimate, selected: Sequence[SelectedTerm]
) -> list[int]:
    """Return the joints at which the terms do not lower the error on the last half, after fits to the first half."""
    jacobian, correlation_length = estimate.problem.jacobian, estimate.problem.selection_correlation_length
    model, samples = jacobian.model, jacobian.samples
    first, last = (samples.select(rows) for rows in split_halves(samples.count, correlation_length))
    terms = copy.deepcopy(model.residuals.state_dict())

    def fit_first(
        estimate: TorqueEstimate, selected: Sequence[SelectedTerm]
    ) -> tuple[TorqueEstimate, torch.Tensor]:
        """Return the fit to the first half, and its squared torque residual (T, n) on the last half."""
        estimate = estimate.with_jacobian(TorqueJacobian(model, first)).with_current_covariance()
        estimate = _refit(estimate, first, selected)
        held_out = TorqueJacobian(model, last).residual_samples(estimate.state.x)
        return estimate, held_out.torque_residual.square()

    with_terms, squares_with_terms = fit_first(estimate, selected)
    clear_terms(model, range(model.n))
    # both fits have the prior of the fit with terms: only the terms differ
    prior = with_terms.problem.prior
    rigid_only = replace(rigid_only, problem=replace(rigid_only.problem, prior=prior))
    _, squares = fit_first(rigid_only, [])
    decrease = squares - squares_with_terms
    model.residuals.load_state_dict(terms)
    # a term is defined at the positions of the first half only
    within = within_range(last.columns.q, first.columns.q)
    losing = (decrease.sum(dim=0) <= 0) & ((decrease * within).sum(dim=0) <= 0)
    return losing.nonzero()[:, 0].tolist()


def _keys(terms: Sequence[SelectedTerm]) -> set[TermKey]:
    return {(term.name, term.joint) for term in terms}
