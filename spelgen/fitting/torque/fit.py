"""Fit of a model of rigid bodies to torques, stage by stage.

initial fit -> choice of friction with or without bristle states -> choice of friction effects (Stribeck, saturation,
    load dependence) -> residual terms -> final fit
    -> comparison with ridge regression on held-out blocks of samples -> another fit if the regression is better
    -> comparison with the model before the fit, which is kept if the fit is not better

The stages before the residual terms use a subset of the samples, residual terms are selected on a larger subset, and
the final fit uses all samples.
"""

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from scipy.special import stdtrit

from spelgen.dynamics.protocol import residual_terms
from spelgen.emission.assemble import ArmModel
from spelgen.fitting.levenberg_marquardt import initial_state
from spelgen.fitting.torque.covariance import Jackknife, contiguous_blocks, jackknife
from spelgen.fitting.torque.jacobian import TorqueJacobian
from spelgen.fitting.torque.parameters import joint_torque, limit_friction, set_initial_gains
from spelgen.fitting.torque.problem import (
    UNBOUNDED,
    TorqueEstimate,
    TorqueProblem,
    refine,
    with_correlation_time,
)
from spelgen.fitting.torque.regression import best_regression, start_at
from spelgen.fitting.torque.samples import TorqueSamples
from spelgen.fitting.torque.selection import SelectedTerm, significant_reduction
from spelgen.fitting.torque.stages import (
    choose_friction_effects,
    choose_friction_state,
    fit_residual_terms,
    initial_fit,
)
from spelgen.fitting.torque.tuning import TUNING
from spelgen.logs.dynamics_samples import DynamicsSamples
from spelgen.settings.fits import Adaptation, GaussianPrior


class FitComparison(NamedTuple):
    """Held-out errors of a torque fit and of simpler methods: ridge regression (see `Regression`), and no fit.

    An error is the mean squared error of held-out blocks divided by the variance of the torque, averaged over joints.

    Attributes:
        fit: error of the returned model.
        regression: error of the ridge regression.
        behind: True if the regression is significantly better than the returned model.
        replaced: error of the fit from the URDF, if a fit from the result of the regression has a smaller error and
            replaced it; otherwise None.
        discarded: error of the fit, if the model before the fit has no larger error and is returned instead of the fit;
            otherwise None.
    """

    fit: float
    regression: float
    behind: bool
    replaced: float | None
    discarded: float | None


@dataclass(frozen=True, eq=False)
class TorqueSolution:
    """Result of a torque fit.

    Attributes:
        rms_residual: root mean square torque residual, (n,) [Nm, N].
        steps: number of accepted steps of the Levenberg-Marquardt solver.
        cost: final cost, the negative log posterior up to a constant.
        prior: prior with the estimated standard deviations.
        covariance: covariance of the K parameters x, (K, K).
        torque_std: root mean square torque error of held-out blocks, (n,) [Nm, N].
        compensated: mask (n,), True for joints whose drives compensate friction.
        correlation_time: correlation time of the torque errors, (n,) [s].
        held_out_nmse: mean squared error of held-out blocks divided by the variance of the torque, (n,).
        selected_terms: the selected residual terms.
        comparison: comparison with simpler methods; None if `fit_torque` fitted only the group of parameters `adapt`.
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
    comparison: FitComparison | None


class _StagedFit(NamedTuple):
    """Result of one run of all stages of a torque fit: estimate, result of `jackknife`, and selected residual terms.

    held_out: (blocks,), sum over joints of the squared held-out residual divided by the variance of the torque.
    parameters: state_dict of the fitted model.
    """

    estimate: TorqueEstimate
    jackknife: Jackknife
    selected: Sequence[SelectedTerm]
    held_out: torch.Tensor
    parameters: dict[str, torch.Tensor]


def fit_torque(
    model: ArmModel,
    samples: TorqueSamples | Sequence[DynamicsSamples],
    prior: GaussianPrior | None = None,
    adapt: Adaptation | None = None,
) -> TorqueSolution:
    """Set the parameters of a model of rigid bodies to their MAP estimate; return it with covariance and torque errors.

    Args:
        model: model whose current parameters are the prior mean. Before a fit of all parameters, the nominal friction
            of each drive is limited to the standard deviation of the drive's logged torque.
        samples: samples with torques as logged, (T, n) [Nm, N].
        prior: initial standard deviations of the prior; None: default.
        adapt: group of parameters to estimate (see `TorqueFit`); None: all parameters. If it is given, residual terms
            are not changed; for "load", the standard deviations of the prior are not updated either.
    """
    if not isinstance(samples, TorqueSamples):
        samples = TorqueSamples.of(samples, TUNING.decimation)
    samples = samples.subsampled(_max_samples(model))
    if prior is None:
        prior = TUNING.priors[adapt] if adapt else GaussianPrior()
    if adapt is None:
        # With `adapt`, motor gains and friction of the model are results of an earlier fit and not nominal values, so
        # they are not changed.
        subset = samples.subsampled(TUNING.initial_samples)
        prior = prior.model_copy(update={"gains": set_initial_gains(model, subset, prior.gains)})
        limit_friction(model, subset.columns)
        fitted, comparison = _compared_fit(model, samples, prior)
    else:
        fitted, comparison = _staged_fit(model, samples, prior, adapt), None
    estimate, state = fitted.estimate, fitted.estimate.state
    jacobian, estimator = estimate.problem.jacobian, estimate.problem.noise_estimator
    scale = jacobian.logged_scale(state.x)
    # mean squared held-out error, (n,) [(Nm)^2, N^2]
    error = fitted.jackknife.held_out.sum(dim=0) / samples.count
    return TorqueSolution(
        rms_residual=((state.residual / samples.count).sqrt() / scale).numpy(),
        steps=state.steps,
        cost=state.cost,
        prior=estimate.problem.prior.widths,
        covariance=fitted.jackknife.covariance,
        torque_std=error.sqrt(),
        compensated=estimate.problem.compensated.numpy(),
        correlation_time=estimate.problem.correlation_time.numpy(),
        held_out_nmse=(error / (estimator.torque_std / scale).square()).numpy(),
        selected_terms=tuple(fitted.selected),
        comparison=comparison,
    )


def _staged_fit(
    model: ArmModel,
    samples: TorqueSamples,
    prior: GaussianPrior,
    adapt: Adaptation | None = None,
    max_error: torch.Tensor = UNBOUNDED,
) -> _StagedFit:
    """Run all stages of a torque fit, from the initial to the final fit (`_run_stages`), then a jackknife over blocks.

    The blocks of the jackknife are contiguous blocks of samples. The prior mean is the vector of the model's current
    parameters.

    prior: standard deviations of the prior. adapt: group of parameters to estimate; None: all parameters. max_error:
    upper bound of the root mean square torque error, (n,) [Nm, N] (see `TorqueProblem`).
    """
    jacobian = TorqueJacobian(model, samples.subsampled(TUNING.initial_samples))
    estimate, selected = _run_stages(TorqueProblem.of(jacobian, prior, adapt, max_error), samples)
    problem = estimate.problem
    problem.jacobian.rigid.write(estimate.state.x)
    errors = jackknife(estimate)
    torque_std = problem.noise_estimator.torque_std / problem.jacobian.logged_scale(estimate.state.x)
    held_out = (errors.held_out / torque_std.square()).sum(dim=1)
    return _StagedFit(estimate, errors, selected, held_out, copy.deepcopy(model.state_dict()))


def _compared_fit(
    model: ArmModel, samples: TorqueSamples, prior: GaussianPrior
) -> tuple[_StagedFit, FitComparison]:
    """Fit all parameters, and fit again if ridge regression predicts held-out torques significantly better.

    The regression has the regressors of bodies, friction and offsets (`Regression`). In the second fit, its held-out
    error is the upper bound of the RMS torque error from which the torque noise is estimated: with a larger noise, a
    badly fitted joint would have a small weight and remain badly fitted. If the regression is still better, a third fit
    has its result as the initial guess. The fit with the smallest held-out error is returned. If its nMSE (squared
    error divided by the variance of the torque) is above `TUNING.unsupported`, and its error is not below the error of
    the model before the fit, the model before the fit is returned. The returned parameters are written to the model.
    prior: initial standard deviations of the prior.
    """
    initial, blocks = copy.deepcopy(model.state_dict()), contiguous_blocks(samples)
    torque_std = joint_torque(model, samples.columns).std(dim=0)
    regression = best_regression(model, blocks, torque_std.numpy())
    squares = torch.from_numpy(regression.held_out)
    # The held-out errors of the fit and of the regression are both increased by the squared lower bound of the noise,
    # so that differences below this bound are not significant.
    negligible = TUNING.min_noise**2 * model.n * torch.tensor([block.count for block in blocks])
    other = squares.sum(dim=1) + negligible

    def behind(fit: _StagedFit) -> bool:
        """Return True if ridge regression has a significantly smaller held-out error than `fit`.

        The errors of the blocks are compared by a t test (p = 0.01).
        """
        if len(blocks) == 1:
            return False
        standard_errors = float(stdtrit(len(blocks) - 1, 0.99))
        return significant_reduction(fit.held_out + negligible, other, standard_errors) is not None

    def nmse(held_out: torch.Tensor) -> float:
        """Return the mean nMSE over the joints: the sum of `held_out`, divided by the numbers of samples and of joints.

        held_out: (blocks,), squared errors divided by the variance of the joint's torque, summed over the samples and
        joints of each block.
        """
        return float(held_out.sum()) / samples.count / model.n

    best, replaced, discarded = _staged_fit(model, samples, prior), None, None
    if behind(best):
        max_error = torque_std * (squares.sum(dim=0) / samples.count).sqrt()
        model.load_state_dict(initial)
        bounded = _staged_fit(model, samples, prior, max_error=max_error)
        best = min(best, bounded, key=lambda fit: float(fit.held_out.sum()))
    if behind(best):
        model.load_state_dict(initial)
        start_at(model, samples.subsampled(TUNING.initial_samples), regression)
        restarted = _staged_fit(model, samples, prior, max_error=max_error)
        if restarted.held_out.sum() < best.held_out.sum():
            best, replaced = restarted, nmse(best.held_out)
    # A fit with a held-out nMSE of at most `TUNING.unsupported` is returned without a comparison with the model before
    # the fit. The model before the fit may predict better, for example with an exact URDF, but has only the wide
    # intervals of the prior; the fit has narrower intervals.
    if nmse(best.held_out) > TUNING.unsupported:
        model.load_state_dict(initial)
        unfitted = _unfitted(model, samples, prior, blocks)
        if unfitted.held_out.sum() <= best.held_out.sum():
            best, discarded = unfitted, nmse(best.held_out)
    model.load_state_dict(best.parameters)
    return best, FitComparison(nmse(best.held_out), nmse(other), behind(best), replaced, discarded)


def _unfitted(
    model: ArmModel, samples: TorqueSamples, prior: GaussianPrior, blocks: Sequence[TorqueSamples]
) -> _StagedFit:
    """Return the model before a fit, in the form of a fit result, for comparison with fits.

    The covariance is the covariance of the prior. blocks: contiguous blocks of `samples`, for which the squared errors
    are computed.
    """
    problem = TorqueProblem.of(TorqueJacobian(model, samples), prior)
    state, free = initial_state(problem, problem.prior.mean), problem.free
    covariance = problem.covariance(problem.prior.precision[free][:, free])
    residual = problem.jacobian.residual_samples(state.x).torque_residual
    sizes = [block.count for block in blocks]
    squares = torch.stack([block.square().sum(dim=0) for block in residual.split(sizes)])
    held_out = (squares / problem.noise_estimator.torque_std.square()).sum(dim=1)
    estimate = TorqueEstimate(problem, state, covariance)
    return _StagedFit(
        estimate, Jackknife(covariance, squares), (), held_out, copy.deepcopy(model.state_dict())
    )


def _run_stages(
    problem: TorqueProblem, samples: TorqueSamples
) -> tuple[TorqueEstimate, Sequence[SelectedTerm]]:
    """Return the estimate after all stages of a torque fit, and the selected residual terms.

    A fit of only one group of parameters (`adapt`) has two stages: the initial fit and the final fit.
    """
    if problem.adapt is not None:
        return refine(initial_fit(problem), samples), ()
    model = problem.jacobian.model
    if model.elements:
        # The initial fit has rate-only friction. Bristles delay the reversal of friction: their parameters would absorb
        # torque errors of inertial parameters that are still wrong.
        model.friction.memoryless.fill_(1.0)
    estimate = initial_fit(problem)
    if model.elements:
        estimate = choose_friction_state(estimate)
    # Correlation times are estimated after the choice of the friction model, since the errors of a wrong friction model
    # have longer correlation times.
    estimate = with_correlation_time(choose_friction_effects(estimate), samples)
    selected: Sequence[SelectedTerm] = ()
    if residual_terms(model) is not None:
        estimate, selected = fit_residual_terms(estimate, samples.subsampled(TUNING.residual_samples))
    # The preceding stages used subsets: the final fit uses all samples.
    return refine(estimate, samples), selected


def _max_samples(model: ArmModel) -> int:
    """Return the largest number of samples of a fit; larger logs are subsampled.

    A fit stores two regressors, one of the torque and one of the gravity torque. Their memory is limited to
    `TUNING.regressor_bytes`.
    """
    numbers = 2 * model.n * model.inertial_parameters.numel()
    return max(TUNING.initial_samples, int(TUNING.regressor_bytes / (8 * numbers)))
