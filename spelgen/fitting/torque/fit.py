"""Fit of a model of rigid bodies to torques, stage by stage.

initial fit -> choice of the friction state -> choice of friction effects -> residual terms -> final fit

The first iterations use a subset of the samples; residual terms are selected on more of them; the final fit uses all.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from spelgen.dynamics.protocol import residual_terms
from spelgen.emission.assemble import ArmModel
from spelgen.fitting.torque.covariance import held_out_nmse, parameter_covariance
from spelgen.fitting.torque.jacobian import TorqueJacobian
from spelgen.fitting.torque.parameters import limit_friction
from spelgen.fitting.torque.problem import (
    TorqueEstimate,
    TorqueProblem,
    refine,
    with_correlation_time,
)
from spelgen.fitting.torque.samples import TorqueSamples
from spelgen.fitting.torque.selection import SelectedTerm
from spelgen.fitting.torque.stages import (
    choose_friction_effects,
    choose_friction_state,
    fit_residual_terms,
    initial_fit,
)
from spelgen.fitting.torque.tuning import TUNING
from spelgen.logs.dynamics_samples import DynamicsSamples
from spelgen.settings.fits import Adaptation, GaussianPrior


@dataclass(frozen=True, eq=False)
class TorqueSolution:
    """Result of a fit.

    rms_residual: (n,) root mean square torque residual [Nm, N]. steps, cost: of the solver, at the end. prior: its
    estimated standard deviations. covariance: (K, K) of x. compensated: (n,) joints whose drives compensate friction.
    correlation_time: (n,) of the torque errors [s]. held_out_nmse: (n,) mean squared error of held-out
    segments, divided by the variance of the torque; torque_std: (n,) its root [Nm, N]. selected_terms: residual terms.
    """

    rms_residual: np.ndarray
    steps: int
    cost: float
    prior: GaussianPrior
    covariance: torch.Tensor
    torque_std: torch.Tensor
    compensated: np.ndarray
    correlation_time: np.ndarray
    held_out_nmse: np.ndarray
    selected_terms: tuple[SelectedTerm, ...]


def fit_torque(
    model: ArmModel,
    samples: TorqueSamples | Sequence[DynamicsSamples],
    prior: GaussianPrior | None = None,
    adapt: Adaptation | None = None,
) -> TorqueSolution:
    """Set the parameters of a model of rigid bodies to their MAP estimate.

    Args:
        model: its current parameters are the prior mean, except for friction larger than the drives' torque.
        samples: torques as logged, (T, n) [Nm, N].
        prior: standard deviations before the fit; None: default.
        adapt: group of parameters to estimate, about their current values (see `TorqueFit`); residual terms, and the
            prior widths of a load, are then fixed. None: all.
    """
    if not isinstance(samples, TorqueSamples):
        samples = TorqueSamples.of(samples, TUNING.decimation)
    samples = samples.subsampled(_max_samples(model))
    subset = samples.subsampled(TUNING.initial_samples)
    if adapt is None:
        # not of an adapted model: its friction was fitted before
        limit_friction(model, subset.columns)
    if prior is None:
        prior = TUNING.priors[adapt] if adapt else GaussianPrior()
    problem = TorqueProblem.of(TorqueJacobian(model, subset), prior, adapt)
    estimate, selected = _run_stages(problem, samples)
    state, jacobian = estimate.state, estimate.problem.jacobian
    jacobian.rigid.write(state.x)
    scale, nmse = jacobian.logged_scale(state.x), held_out_nmse(estimate, samples)
    rms = (state.residual / samples.count).sqrt() / scale
    return TorqueSolution(
        rms_residual=rms.numpy(),
        steps=state.steps,
        cost=state.cost,
        prior=estimate.problem.prior.widths,
        covariance=parameter_covariance(estimate),
        torque_std=nmse.sqrt() * estimate.problem.noise_estimator.torque_std / scale,
        compensated=estimate.problem.compensated.numpy(),
        correlation_time=estimate.problem.correlation_time.numpy(),
        held_out_nmse=nmse.numpy(),
        selected_terms=tuple(selected),
    )


def _run_stages(
    problem: TorqueProblem, samples: TorqueSamples
) -> tuple[TorqueEstimate, Sequence[SelectedTerm]]:
    """Return the estimate after all stages, and the selected residual terms."""
    if problem.adapt is not None:
        return refine(initial_fit(problem), samples), ()
    model = problem.jacobian.model
    if model.elements:
        # friction without state first: bristles would delay reversals of bodies that are far off
        model.friction.memoryless.fill_(1.0)
    estimate = initial_fit(problem)
    if model.elements:
        estimate = choose_friction_state(estimate)
    # the errors of a wrong friction model last longer than those of the chosen one
    estimate = with_correlation_time(choose_friction_effects(estimate), samples)
    selected: Sequence[SelectedTerm] = ()
    if residual_terms(model) is not None:
        estimate, selected = fit_residual_terms(estimate, samples.subsampled(TUNING.residual_samples))
    # residual terms were selected on fewer samples
    return refine(estimate, samples), selected


def _max_samples(model: ArmModel) -> int:
    """Return the maximum number of samples: their two regressors are kept in memory."""
    numbers = 2 * model.n * model.inertial_parameters.numel()
    return max(TUNING.initial_samples, int(TUNING.regressor_bytes / (8 * numbers)))
