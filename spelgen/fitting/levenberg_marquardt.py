"""Damped Gauss-Newton steps (Levenberg-Marquardt) down the cost of a nonlinear least-squares problem.

Marquardt, J. SIAM 11:431 (1963): the curvature's diagonal is enlarged by a damping factor, which falls after a step
that lowers the cost and rises until one does. What a problem moves (a vector of weights, or the weights of servos with
their delay) and what it keeps of its residuals are its own; the solver only compares costs.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Generic, NamedTuple, Protocol, TypeVar

import torch

from spelgen.fitting.tuning import DampingTuning

TUNING = DampingTuning()

Unknowns = TypeVar("Unknowns")


class NormalEquations(NamedTuple):
    """A cost's curvature (..., k, k) by Gauss-Newton, and minus its gradient (..., k)."""

    curvature: torch.Tensor
    descent: torch.Tensor

    def step(self, damping: float | torch.Tensor = 0.0) -> torch.Tensor:
        """Return the damped step (..., k); damping: one for all, or (...) of each system of equations."""
        factor = torch.as_tensor(damping, dtype=self.curvature.dtype)[..., None, None]
        diagonal = torch.diag_embed(self.curvature.diagonal(dim1=-2, dim2=-1))
        result: torch.Tensor = torch.linalg.solve(self.curvature + factor * diagonal, self.descent)
        return result

    def promised(self, step: torch.Tensor) -> float:
        """Return by how much the quadratic model of the cost falls along a step (k,)."""
        return float(step @ (self.descent - self.curvature @ step / 2))


@dataclass(frozen=True, eq=False)
class SolverState(Generic[Unknowns]):
    """Hold where the steps have come to.

    residuals: what the problem found there, to be used again. damping: of the next step. steps: taken so far, over all
    calls. converged: whether no step follows.
    """

    x: Unknowns
    residuals: torch.Tensor
    cost: float
    damping: float
    steps: int = 0
    converged: bool = False


class LeastSquares(Protocol[Unknowns]):
    """A cost of unknowns, by way of residuals (or of their sums of squares, where these are too many to keep)."""

    def residuals(self, x: Unknowns) -> torch.Tensor:
        """Return what the cost and the normal equations are computed from."""

    def cost(self, x: Unknowns, residuals: torch.Tensor) -> float:
        """Return the cost; infinite where numbers blew up."""

    def normal_equations(self, x: Unknowns, residuals: torch.Tensor) -> NormalEquations:
        """Return curvature and minus gradient of the cost by the unknowns that move."""

    def moved(self, x: Unknowns, step: torch.Tensor) -> Iterable[Unknowns]:
        """Return where a step leads; a second way there is only tried where the first keeps little of its promise."""


def start(
    problem: LeastSquares[Unknowns], x: Unknowns, damping: float = TUNING.first, steps: int = 0
) -> SolverState[Unknowns]:
    """Return the state before the first step from ``x``."""
    residuals = problem.residuals(x)
    return SolverState(x, residuals, problem.cost(x, residuals), damping, steps)


def levenberg_marquardt(
    problem: LeastSquares[Unknowns],
    state: SolverState[Unknowns],
    *,
    max_steps: int,
    least_gain: float = 0.0,
    relative_gain: float = 0.0,
) -> Iterator[SolverState[Unknowns]]:
    """Yield the state after each step that lowers the cost.

    The last one has ``converged`` set: it gained less than ``least_gain`` or less than ``relative_gain`` times the
    cost, or it is the state before, from which no step gains. None has where ``max_steps`` ended the steps.
    """
    for _ in range(max_steps):
        if state.converged:
            return
        lower = _lower(problem, state, least_gain)
        if lower is None:
            yield replace(state, converged=True)
            return
        gain = state.cost - lower.cost
        state = replace(lower, converged=gain < max(least_gain, relative_gain * lower.cost))
        yield state


def _lower(
    problem: LeastSquares[Unknowns], state: SolverState[Unknowns], least_gain: float
) -> SolverState[Unknowns] | None:
    """Return the state after one step that lowers the cost; None: none does, or none promises to."""
    normal = problem.normal_equations(state.x, state.residuals)
    damping = state.damping
    for _ in range(TUNING.tries):
        step = normal.step(damping)
        promised = normal.promised(step)
        if promised < max(TUNING.least_promise * state.cost, least_gain):
            return None
        lower = _best(problem, state, step, promised)
        if lower.cost < state.cost:
            return replace(lower, damping=max(damping / TUNING.factor, TUNING.least))
        damping *= TUNING.factor
    return None


def _best(
    problem: LeastSquares[Unknowns], state: SolverState[Unknowns], step: torch.Tensor, promised: float
) -> SolverState[Unknowns]:
    """Return the state of least cost among the ways of a step, as far as these are worth trying."""
    best = replace(state, cost=float("inf"))
    for x in problem.moved(state.x, step):
        tried = start(problem, x, state.damping, state.steps + 1)
        if tried.cost < best.cost:
            best = tried
        if state.cost - best.cost >= TUNING.kept_promise * promised:
            break
    return best
