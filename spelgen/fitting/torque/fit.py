"""Fit rigid bodies to torques: their most probable weights, by Levenberg-Marquardt steps.

Few samples come near, all of them finish. What a model has beside rigid bodies is fitted to what these leave, where it
pays (see ``selection``), and both are fitted together.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch

from spelgen.dynamics.protocol import residual_terms
from spelgen.fitting.torque.jacobian import TUNING, TorqueJacobian
from spelgen.fitting.torque.joint_functions import clear_functions, refit_residuals
from spelgen.fitting.torque.problem import State, TorqueProblem
from spelgen.fitting.torque.samples import TorqueSamples
from spelgen.fitting.torque.selection import (
    SelectedResidual,
    between_positions,
    can_be_judged,
    halves,
    select_functions,
    select_networks,
)
from spelgen.fitting.torque.weights import bound_friction
from spelgen.logs.dynamics_samples import DynamicsSamples
from spelgen.settings.fits import Adaptation, GaussianPrior

if TYPE_CHECKING:
    from spelgen.emission.assemble import ArmModel


@dataclass(frozen=True, eq=False)
class TorqueSolution:
    """How a fit ended.

    residual: (n,) root mean square of the torque that is missed [Nm, N]. prior: as the fit found it. covariance: of the
    weights after the fit (K, K), zero for those that did not move. compensated: (n,) joints whose drives add torque
    that is not measured. residuals: what was selected beside rigid bodies.
    """

    residual: np.ndarray
    steps: int
    cost: float
    prior: GaussianPrior
    covariance: torch.Tensor
    compensated: np.ndarray
    residuals: tuple[SelectedResidual, ...]


def fit_torque(
    model: ArmModel,
    samples: TorqueSamples | Sequence[DynamicsSamples],
    prior: GaussianPrior | None = None,
    adapt: Adaptation | None = None,
) -> TorqueSolution:
    """Set the weights of a closed-form ``model`` to the most probable ones after ``samples`` (torques as logged).

    The prior is centred on the weights as they are, but no friction there is larger than its drive's torque. ``adapt``:
    these move alone, about the weights as they are; what stands beside rigid bodies stays, and so does the prior of a
    load (see ``TorqueFit``).
    """
    if not isinstance(samples, TorqueSamples):
        samples = TorqueSamples.of(samples, TUNING.decimation)
    samples = samples.thinned(_most_samples(model))
    subset = samples.thinned(TUNING.subset)
    if adapt is None:
        bound_friction(model, subset.columns)
    if prior is None:
        prior = TUNING.priors[adapt] if adapt else GaussianPrior()
    problem = TorqueProblem(TorqueJacobian(model, subset), prior, adapt)
    select_memory = adapt is None and model.elements > 0
    if select_memory:
        model.friction.memoryless.fill_(1.0)
    state = problem.solve_from_start()
    if select_memory:
        state = problem.select_memory(state)
    if adapt is None:
        state = problem.select_effects(state)
    residuals: list[SelectedResidual] = []
    if adapt is None and residual_terms(model) is not None:
        state, residuals = _with_residuals(problem, state, samples.thinned(TUNING.residual_samples))
    if problem.jacobian.samples is not samples:  # few samples came near, all of them finish
        state = problem.refine(state, samples)
    problem.jacobian.rigid.write(state.x)
    rms = (state.residuals / samples.count).sqrt() / problem.jacobian.per_gain(state.x)
    return TorqueSolution(
        residual=rms.numpy(),
        steps=state.steps,
        cost=state.cost,
        prior=problem.prior,
        covariance=problem.covariance,
        compensated=problem.compensated.numpy(),
        residuals=tuple(residuals),
    )


def _most_samples(model: ArmModel) -> int:
    """Return how many samples there may be: their two regressors stay in memory from step to step."""
    numbers = 2 * model.n * model.inertial_parameters.numel()
    return max(TUNING.subset, int(TUNING.regressor_bytes / (8 * numbers)))


def _with_residuals(
    problem: TorqueProblem, state: State, samples: TorqueSamples
) -> tuple[State, list[SelectedResidual]]:
    """Select what stands beside rigid bodies, and fit both."""
    model = problem.jacobian.model
    if samples is not problem.jacobian.samples:
        state = problem.refine(state, samples)
    problem.jacobian.rigid.write(state.x)
    residuals: list[SelectedResidual] = []
    if not can_be_judged(samples.count, problem.lasting):
        return state, residuals
    alone, snapshot = state, problem.snapshot()
    # bodies that were fitted without a function err by more than it: only then is seen what else is missed
    while further := select_functions(model, *problem.around(state), _chosen(residuals), problem.lasting):
        residuals += further
        state = _refit(problem, state, samples, residuals)
    if residuals:
        losing = _losing_joints(problem, alone, state, residuals)
        residuals = [residual for residual in residuals if residual.joint not in losing]
        clear_functions(model, losing)
        if not residuals:
            state = alone
            problem.restore(snapshot)
        # the model has the bodies of a half: its armature bounds the networks of M
        problem.jacobian.rigid.write(state.x)
        state = problem.set_samples(state, TorqueJacobian(model, samples))
    residuals += select_networks(model, problem.jacobian.residual_samples(state.x), problem.lasting)
    for _ in range(TUNING.turns if residuals else 0):
        state = _refit(problem, state, samples, residuals)
    return state, residuals


def _losing_joints(
    problem: TorqueProblem, alone: State, state: State, residuals: Sequence[SelectedResidual]
) -> list[int]:
    """Return the joints whose last half of the samples bodies alone meet as well or better, after fits to the first.

    alone: of a fit of bodies. state: of one beside functions.
    """
    model, samples, snapshot = problem.jacobian.model, problem.jacobian.samples, problem.snapshot()
    first, last = halves(samples.count, problem.lasting)
    early, late = samples.rows(first), samples.rows(last)
    weights = copy.deepcopy(model.residuals.state_dict())

    def missed(state: State, residuals: Sequence[SelectedResidual]) -> torch.Tensor:
        state = problem.set_samples(state, TorqueJacobian(model, early))
        state = _refit(problem, state, early, residuals)
        return TorqueJacobian(model, late).residual_samples(state.x).missing.square()

    beside = missed(state, residuals)
    clear_functions(model, range(model.n))
    gain = missed(alone, []) - beside
    model.residuals.load_state_dict(weights)
    problem.restore(snapshot)
    # functions are known between the positions that they were fitted to
    between = between_positions(late.columns.q, early.columns.q)
    loses = (gain.sum(dim=0) <= 0) & ((gain * between).sum(dim=0) <= 0)
    return loses.nonzero()[:, 0].tolist()


def _refit(
    problem: TorqueProblem, state: State, samples: TorqueSamples, residuals: Sequence[SelectedResidual]
) -> State:
    """Fit the selected functions of joints, and bodies with them."""
    model = problem.jacobian.model
    following = refit_residuals(model, *problem.around(state), _chosen(residuals), problem.lasting)
    state = problem.refine(state, samples, following.functions)
    problem.jacobian.rigid.write(state.x)
    following.write(model, problem.jacobian.residual_samples(state.x).missing)
    return problem.set_samples(state, TorqueJacobian(model, samples))


def _chosen(residuals: Sequence[SelectedResidual]) -> set[tuple[str, int | None]]:
    """Return which residuals these are: parameters and joints."""
    return {(residual.name, residual.joint) for residual in residuals}
