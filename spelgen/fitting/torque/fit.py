"""Fit of a model of rigid bodies to torques, stage by stage.

initial fit -> choice of the friction state -> choice of friction effects -> residual terms -> final fit

The first iterations use a subset of the samples; residual terms are selected on more of them; the final fit uses all.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch

from spelgen.dynamics.protocol import residual_terms
from spelgen.emission.assemble import ArmModel
from spelgen.fitting.levenberg_marquardt import Termination
from spelgen.fitting.torque.covariance import parameter_covariance
from spelgen.fitting.torque.jacobian import TorqueJacobian
from spelgen.fitting.torque.parameters import limit_friction
from spelgen.fitting.torque.problem import (
    TorqueEstimate,
    TorqueProblem,
    held_out_nmse,
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


class FitStage(NamedTuple):
    """Stage of a fit, with the state at its end: accepted steps since the first stage, cost, reason of termination.

    Costs of two stages are comparable only if they have the same samples, noise and prior.
    """

    name: str
    steps: int
    cost: float
    termination: Termination


@dataclass(frozen=True, eq=False)
class TorqueSolution:
    """Result of a fit.

    rms_residual: (n,) root mean square torque residual [Nm, N]. steps, cost: of the solver, at the end. prior: its
    estimated standard deviations. covariance, torque_std: see `ParameterCovariance`. compensated: (n,) joints whose
    drives compensate friction. correlation_time: (n,) of the torque errors [s]. held_out_nmse: (n,) mean squared error
    of held-out segments, divided by the variance of the torque. selected_terms: residual terms. stages: in order.
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
    stages: tuple[FitStage, ...]


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
        limit_friction(model, subset.columns)
    if prior is None:
        prior = TUNING.priors[adapt] if adapt else GaussianPrior()
    problem = TorqueProblem.of(TorqueJacobian(model, subset), prior, adapt)
    estimate, selected, stages = _run_stages(problem, samples)
    state, jacobian = estimate.state, estimate.problem.jacobian
    jacobian.rigid.write(state.x)
    uncertainty = parameter_covariance(estimate)
    rms = (state.residual / samples.count).sqrt() / jacobian.logged_scale(state.x)
    return TorqueSolution(
        rms_residual=rms.numpy(),
        steps=state.steps,
        cost=state.cost,
        prior=estimate.problem.prior.widths,
        covariance=uncertainty.covariance,
        torque_std=uncertainty.torque_std,
        compensated=estimate.problem.compensated.numpy(),
        correlation_time=estimate.problem.correlation_time.numpy(),
        held_out_nmse=held_out_nmse(estimate, samples).numpy(),
        selected_terms=tuple(selected),
        stages=tuple(stages),
    )


def _run_stages(
    problem: TorqueProblem, samples: TorqueSamples
) -> tuple[TorqueEstimate, list[SelectedTerm], list[FitStage]]:
    """Return the estimate after all stages, the selected residual terms, and the record of the stages."""
    model, stages = problem.jacobian.model, []
    selected: list[SelectedTerm] = []

    def done(name: str, estimate: TorqueEstimate) -> None:
        stages.append(FitStage(name, estimate.state.steps, estimate.state.cost, estimate.termination))

    choose_state = problem.adapt is None and model.elements > 0
    if choose_state:
        model.friction.memoryless.fill_(1.0)
    estimate = initial_fit(problem)
    done("initial fit", estimate)
    if choose_state:
        estimate = choose_friction_state(estimate)
        done("friction state", estimate)
    if problem.adapt is None:
        estimate = with_correlation_time(choose_friction_effects(estimate), samples)
        done("friction effects", estimate)
        if residual_terms(model) is not None:
            estimate, selected = fit_residual_terms(estimate, samples.subsampled(TUNING.residual_samples))
            done("residual terms", estimate)
    estimate = refine(estimate, samples)
    done("final fit", estimate)
    return estimate, selected, stages


def _max_samples(model: ArmModel) -> int:
    """Return the maximum number of samples: their two regressors are kept in memory."""
    numbers = 2 * model.n * model.inertial_parameters.numel()
    return max(TUNING.initial_samples, int(TUNING.regressor_bytes / (8 * numbers)))
