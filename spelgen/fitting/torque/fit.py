"""Fit of a model of rigid bodies to torques, stage by stage.

initial fit -> choice of the friction state -> choice of friction effects -> residual terms -> final fit

The stages before the residual terms use a subset of the samples, residual terms are selected on a larger subset, and
the final fit uses all samples.
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
    """Result of a torque fit.

    rms_residual: root mean square torque residual, (n,) [Nm, N]. steps: number of steps of the solver. cost: final
    cost. prior: prior with the estimated standard deviations. covariance: covariance of the parameters x, (K, K).
    torque_std: root mean square torque error of held-out segments, (n,) [Nm, N]. compensated: joints whose drives
    compensate friction, (n,). correlation_time: correlation time of the torque errors, (n,) [s]. held_out_nmse: mean
    squared error of held-out segments divided by the variance of the torque, (n,). selected_terms: the selected
    residual terms.
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
        model: model whose current parameters are the prior mean. Before a fit of all parameters, nominal friction that
            exceeds the standard deviation of a drive's logged torque is reduced to it.
        samples: samples with torques as logged, (T, n) [Nm, N].
        prior: initial standard deviations of the prior; None: default.
        adapt: group of parameters to estimate (see `TorqueFit`); the prior mean is then their current values. Residual
            terms, and the prior widths of a load, are then fixed. None: estimate all parameters.
    """
    if not isinstance(samples, TorqueSamples):
        samples = TorqueSamples.of(samples, TUNING.decimation)
    samples = samples.subsampled(_max_samples(model))
    subset = samples.subsampled(TUNING.initial_samples)
    if adapt is None:
        # The friction of an adapted model is not nominal but fitted, so it is not limited.
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
        # The initial fit has rate-only friction. Bristles delay the reversal of friction, and this delay would be
        # fitted to the torque errors of inertial parameters that are still wrong.
        model.friction.memoryless.fill_(1.0)
    estimate = initial_fit(problem)
    if model.elements:
        estimate = choose_friction_state(estimate)
    # Correlation times are estimated after the choice of the friction model, since a wrong friction model has
    # errors that last longer.
    estimate = with_correlation_time(choose_friction_effects(estimate), samples)
    selected: Sequence[SelectedTerm] = ()
    if residual_terms(model) is not None:
        estimate, selected = fit_residual_terms(estimate, samples.subsampled(TUNING.residual_samples))
    # The preceding stages used subsets: the final fit uses all samples.
    return refine(estimate, samples), selected


def _max_samples(model: ArmModel) -> int:
    """Return the largest number of samples of a fit.

    The regressors of torque and of gravity torque, which are kept in memory, have at most `TUNING.regressor_bytes`.
    """
    numbers = 2 * model.n * model.inertial_parameters.numel()
    return max(TUNING.initial_samples, int(TUNING.regressor_bytes / (8 * numbers)))
