"""Levenberg-Marquardt minimization of a nonlinear least-squares cost.

Marquardt, J. SIAM 11:431 (1963): a step s solves (H + damping diag H) s = -g, with the Gauss-Newton Hessian H and the
gradient g of the cost. After a step that lowers the cost, the damping is divided by a factor; otherwise the damping is
multiplied by the same factor, and the step is repeated. The parameters may be of any type, for example a vector or a
dataclass: the solver only passes them between the functions of the problem.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from enum import Enum
from typing import Generic, NamedTuple, Protocol, TypeVar

import torch
from torch import Tensor

from spelgen.fitting.tuning import TUNING

Parameters = TypeVar("Parameters")


class Termination(Enum):
    """Reason why the solver ended."""

    SMALL_DECREASE = "the last step lowered the cost by less than the threshold"
    SMALL_PREDICTION = "the predicted decrease of the cost is below the threshold"
    NO_DECREASE = "no damping lowers the cost"
    MAX_STEPS = "maximum number of steps"


class NormalEquations(NamedTuple):
    """Gauss-Newton Hessian H, (..., k, k), and negative gradient -g, (..., k), of a cost with k parameters."""

    curvature: Tensor
    descent: Tensor

    def step(self, damping: float | Tensor = 0.0) -> Tensor:
        """Return the steps (H + damping diag H)^-1 (-g), (..., k), with the Hessian H and the gradient g.

        damping: one number for all systems of equations, or (...), one number per system.
        """
        factor = torch.as_tensor(damping, dtype=self.curvature.dtype)[..., None, None]
        # Marquardt's scaling by diag H instead of Levenberg's identity: steps are independent of the parameters' units.
        diagonal = torch.diag_embed(self.curvature.diagonal(dim1=-2, dim2=-1))
        result: Tensor = torch.linalg.solve(self.curvature + factor * diagonal, self.descent)
        return result

    def predicted_decrease(self, step: Tensor) -> float:
        """Return the decrease of the cost by a step s (k,) in its quadratic model: -g^T s - s^T H s / 2.

        H is the Gauss-Newton Hessian, g the gradient of the cost.
        """
        return float(step @ (self.descent - self.curvature @ step / 2))


@dataclass(frozen=True, eq=False)
class SolverState(Generic[Parameters]):
    """Iterate of the solver.

    Attributes:
        x: parameters.
        residual: residual of the problem at x, from which the normal equations are computed.
        cost: cost at x.
        damping: damping of the next step.
        steps: number of accepted steps, including earlier calls of the solver.
    """

    x: Parameters
    residual: Tensor
    cost: float
    damping: float
    steps: int = 0


@dataclass(frozen=True, eq=False)
class SolverResult(Generic[Parameters]):
    """Last iterate and reason of termination.

    normal_equations: the latest computed normal equations. They are at the last iterate if the solver ended because no
    further step was accepted. If it ended directly after an accepted step (small decrease of the cost, maximum number
    of steps), they are at the iterate before this step.
    """

    state: SolverState[Parameters]
    termination: Termination
    normal_equations: NormalEquations


class LeastSquaresProblem(Protocol[Parameters]):
    """Nonlinear least-squares problem, whose cost is computed from the residual of parameters x.

    The solver passes the result of `residual` to `cost` and `normal_equations`, and does not use it otherwise.
    """

    def residual(self, x: Parameters) -> Tensor:
        """Return the residual of n joints at x, (..., n).

        A problem whose residual is too large for the memory returns the sum of squares per joint, (n,), instead.
        """

    def cost(self, x: Parameters, residual: Tensor) -> float:
        """Return the cost at x, computed from the result of `residual` at x; infinite if the residual diverged."""

    def normal_equations(self, x: Parameters, residual: Tensor) -> NormalEquations:
        """Return the Gauss-Newton Hessian (k, k) and the negative gradient (k,) with respect to k free parameters.

        residual: result of `residual` at x.
        """

    def candidates(self, x: Parameters, step: Tensor) -> Iterable[Parameters]:
        """Return one or more candidates for the parameters x after a step (k,) of the k free parameters.

        A problem may have several candidates, for example x + step, and a point on a curve along which its residual is
        less nonlinear. The solver evaluates the next candidate only if the gain ratio of the best candidate so far
        (decrease of the cost divided by the predicted decrease) is low.
        """


def initial_state(
    problem: LeastSquaresProblem[Parameters],
    x: Parameters,
    damping: float = TUNING.initial_damping,
    steps: int = 0,
) -> SolverState[Parameters]:
    """Return the state of the solver at x, with the residual and the cost at x.

    damping: damping of the next step. steps: number of accepted steps so far, including earlier calls of the solver.
    """
    residual = problem.residual(x)
    return SolverState(x, residual, problem.cost(x, residual), damping, steps)


def levenberg_marquardt(
    problem: LeastSquaresProblem[Parameters],
    state: SolverState[Parameters],
    *,
    max_steps: int,
    min_decrease: float = 0.0,
    min_relative_decrease: float = 0.0,
    callback: Callable[[SolverState[Parameters]], None] = lambda state: None,
) -> SolverResult[Parameters]:
    """Minimize the cost of a problem; return the last iterate and the reason of termination.

    Args:
        problem: cost, residual and normal equations.
        state: first iterate, from `initial_state` or from the result of an earlier call.
        max_steps: maximum number of accepted steps.
        min_decrease: the solver ends if the decrease of the cost, or the predicted decrease, is smaller.
        min_relative_decrease: the solver ends if the decrease, divided by the cost after the step, is smaller.
        callback: is called with the state after each accepted step.
    """
    # The normal equations are computed even if max_steps is 0, because the result contains them.
    normal = problem.normal_equations(state.x, state.residual)
    for number in range(max_steps):
        if number:
            normal = problem.normal_equations(state.x, state.residual)
        accepted = _accepted_step(problem, state, normal, min_decrease)
        if isinstance(accepted, Termination):
            return SolverResult(state, accepted, normal)
        decrease, state = state.cost - accepted.cost, accepted
        callback(state)
        if decrease < max(min_decrease, min_relative_decrease * state.cost):
            return SolverResult(state, Termination.SMALL_DECREASE, normal)
    return SolverResult(state, Termination.MAX_STEPS, normal)


def _accepted_step(
    problem: LeastSquaresProblem[Parameters],
    state: SolverState[Parameters],
    normal: NormalEquations,
    min_decrease: float,
) -> SolverState[Parameters] | Termination:
    """Return the state after a step that lowers the cost, or the reason of termination if there is no such step.

    The damping is raised until a step lowers the cost. min_decrease: smallest predicted decrease of the cost for which
    a step is tried.
    """
    damping, rejected = state.damping, torch.full_like(normal.descent, torch.inf)
    for _ in range(TUNING.max_trials):
        step = normal.step(damping)
        predicted = normal.predicted_decrease(step)
        # The search for a damping ends at a small predicted decrease of the cost: a larger damping would have an even
        # smaller one.
        if predicted < max(TUNING.min_predicted_decrease * state.cost, min_decrease):
            return Termination.SMALL_PREDICTION
        # A damping far below the eigenvalues of the scaled H hardly changes the step. A step that is nearly equal to
        # the last rejected step would be rejected, too, and its cost is not computed.
        if (step - rejected).abs().max() > TUNING.same_step * step.abs().max():
            best = _best_candidate(problem, state, step, predicted)
            if best.cost < state.cost:
                # The damping has a lower bound: from a much smaller value, many rejected steps would be needed to raise
                # it again.
                return replace(best, damping=max(damping / TUNING.damping_factor, TUNING.min_damping))
            rejected = step
        damping *= TUNING.damping_factor
    return Termination.NO_DECREASE


def _best_candidate(
    problem: LeastSquaresProblem[Parameters],
    state: SolverState[Parameters],
    step: Tensor,
    predicted: float,
) -> SolverState[Parameters]:
    """Return the state of minimum cost among the candidates of a step.

    A candidate is a parameter vector after the step, such as x + step (see `LeastSquaresProblem.candidates`).
    Candidates after the first one with a high gain ratio are not evaluated. The gain ratio is the decrease of the cost
    divided by its predicted decrease. state: state before the step. step: (k,). predicted: predicted decrease of the
    cost.
    """
    best = replace(state, cost=float("inf"))
    for x in problem.candidates(state.x, step):
        candidate = initial_state(problem, x, state.damping, state.steps + 1)
        if candidate.cost < best.cost:
            best = candidate
        # At a high gain ratio, the quadratic model predicts the decrease of the cost well: further candidates would
        # lower the cost little.
        if state.cost - best.cost >= TUNING.min_gain_ratio * predicted:
            break
    return best
