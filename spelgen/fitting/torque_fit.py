"""Fit a closed-form model to torques: its most probable weights, by Gauss-Newton steps (Levenberg-Marquardt).

The torque is linear in the bodies' parameters, which the log-Cholesky weights make possible ones, and smooth in the
few constants of each joint: seconds are enough, and no step size is to be chosen. What is minimised is

    sum over joints and samples of (missing torque / noise)^2 + (weights - start)^T covariance^-1 (weights - start),

a Gaussian prior (see ``Belief``). The noise of a joint is what is left of its torque, found in rounds.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch.func import functional_call, jacfwd, jvp

from spelgen.fitting.gaussian_prior import Belief
from spelgen.identification.samples import DynamicsSamples

if TYPE_CHECKING:
    from spelgen.fitting.run_folder import EmittedModel

EVERY = 2  # samples taken of so many: filtered at 8 Hz and sampled at 100 Hz they say all that is to be said
ALIKE = 20.0  # of those: so many in a row, 0.4 s, err alike and count once
ROUNDS = 6  # of weighing joints by what is left of their torque
STEPS = 8  # at most in a round
GAIN = 1e-4  # relative: a step that gains less ends a round
FIRST_NOISE = 0.1  # of a joint's torque range
LEAST_NOISE = 1e-4  # likewise: noise-free samples are fitted to four digits of their torque's range
DAMPING = (1e-9, 1e-3, 1e6)  # of the steps, relative to the curvature: least, first, most


@dataclass(frozen=True, eq=False)
class TorqueFit:
    """How a fit ended. residual: (n,) root mean square of the torque that is missed [Nm, N]."""

    residual: np.ndarray
    steps: int
    cost: float


def fit_torque(
    model: EmittedModel,
    samples: Sequence[DynamicsSamples],
    belief: Belief | None = None,
    only_bodies: Sequence[int] | None = None,
) -> TorqueFit:
    """Set the weights of a closed-form ``model`` to the most probable ones after ``samples`` (torques as logged).

    The prior is centred on the weights as they are. ``only_bodies``: nothing moves but these bodies' parameters.
    """
    problem = _Problem(model, samples, belief or Belief(), only_bodies)
    x, damping, steps, cost = problem.start, DAMPING[1], 0, float("inf")
    left = problem.missing(x)
    noise = ALIKE**0.5 * FIRST_NOISE * problem.range
    for _ in range(ROUNDS):
        cost = problem.cost(x, left, noise)
        for _ in range(STEPS):
            stepped = problem.step(x, left, noise, cost, damping)
            if stepped is None:
                break
            x, left, lower, damping = stepped
            gained, cost, steps = cost - lower, lower, steps + 1
            if gained < GAIN * cost:
                break
        noise = problem.noise(left)
    problem.write(x)
    return TorqueFit(left.square().mean(dim=0).sqrt().numpy(), steps, cost)


@dataclass(frozen=True, eq=False)
class _Data:
    """All samples (T, n), and the regressors (T, n, 10 B) of torque and of gravity torque at them."""

    qd: torch.Tensor
    qdd: torch.Tensor
    tau: torch.Tensor
    rows: torch.Tensor
    heavy: torch.Tensor


class _Asked(torch.nn.Module):
    """Answers questions about a model, so that ``functional_call`` can ask them under other weights."""

    def __init__(self, model: EmittedModel) -> None:
        super().__init__()
        self.model = model

    def forward(self, question: Callable[[Any], Any]) -> Any:
        return question(self.model)


class _Problem:
    def __init__(
        self,
        model: EmittedModel,
        samples: Sequence[DynamicsSamples],
        belief: Belief,
        only_bodies: Sequence[int] | None,
    ) -> None:
        self.model: Any = model
        self.asked = _Asked(model)
        self.data = _data(model, samples)
        self.weights = {name: x.detach().clone() for name, x in model.named_parameters()}
        self.start = torch.cat([x.flatten() for x in self.weights.values()])
        self.precision = torch.linalg.inv(belief.covariance(self.weights))
        self.free = torch.ones_like(self.start, dtype=torch.bool)
        if only_bodies is not None:
            chosen = {name: torch.zeros_like(x, dtype=torch.bool) for name, x in self.weights.items()}
            chosen["bodies"][list(only_bodies)] = True
            self.free = torch.cat([x.flatten() for x in chosen.values()])
        spread = (self.data.tau @ model.prepare().input.mT.detach()).std(dim=0)
        self.range = torch.maximum(spread, 1e-3 * spread.max())

    def missing(self, x: torch.Tensor) -> torch.Tensor:
        """The torque that the model does not explain, (T, n)."""
        return self._ask(self._named(x), self._missing).detach()

    def noise(self, left: torch.Tensor) -> torch.Tensor:
        """Standard deviations (n,) of errors as if they were independent from sample to sample."""
        found = left.square().mean(dim=0).sqrt()
        return ALIKE**0.5 * torch.maximum(found, LEAST_NOISE * self.range)

    def cost(self, x: torch.Tensor, left: torch.Tensor, noise: torch.Tensor) -> float:
        away = x - self.start
        return float(((left / noise).square().sum() + away @ self.precision @ away) / 2)

    def step(
        self, x: torch.Tensor, left: torch.Tensor, noise: torch.Tensor, cost: float, damping: float
    ) -> tuple[torch.Tensor, torch.Tensor, float, float] | None:
        """Weights, missing torque, cost and damping after a step that lowers the cost; None: there is none."""
        slope = (self._slope(self._named(x)) / noise[:, None]).flatten(0, 1)[:, self.free]
        curvature = slope.mT @ slope + self.precision[self.free][:, self.free]
        target = slope.mT @ (left / noise).flatten() - (self.precision @ (x - self.start))[self.free]
        while damping < DAMPING[2]:
            damped = curvature + damping * torch.diag(curvature.diagonal())
            moved = x.clone()
            moved[self.free] += torch.linalg.solve(damped, target)
            after = self.missing(moved)
            lower = self.cost(moved, after, noise)
            if lower < cost:
                return moved, after, lower, max(damping / 10, DAMPING[0])
            damping *= 10
        return None

    def write(self, x: torch.Tensor) -> None:
        """Put the weights into the model."""
        named = self._named(x)
        with torch.no_grad():
            for name, parameter in self.model.named_parameters():
                parameter.copy_(named[name])

    def _named(self, x: torch.Tensor) -> dict[str, torch.Tensor]:
        parts = x.split([weight.numel() for weight in self.weights.values()])
        return {
            name: part.view_as(weight)
            for (name, weight), part in zip(self.weights.items(), parts, strict=True)
        }

    def _ask(self, named: dict[str, torch.Tensor], question: Callable[[Any], Any]) -> Any:
        return functional_call(self.asked, {f"model.{name}": x for name, x in named.items()}, (question,))

    def _missing(self, model: Any) -> torch.Tensor:
        data, prepared = self.data, model.prepare()
        ten = model.inertial_parameters().flatten()
        friction = model.friction(data.qd, data.heavy @ ten, prepared.friction)
        given: torch.Tensor = (data.tau - model.torque_offset()) @ prepared.input.mT
        return given - data.rows @ ten - prepared.rotors * data.qdd - friction

    def _slope(self, named: dict[str, torch.Tensor]) -> torch.Tensor:
        """Minus d(missing torque) / d(weights), (T, n, weights)."""
        parts = [
            self._body_slope(named) if name == "bodies" else self._own_slope(named, name) for name in named
        ]
        return torch.cat(parts, dim=-1)

    def _own_slope(self, named: dict[str, torch.Tensor], name: str) -> torch.Tensor:
        """By weights of which each joint has its own, which move its own torque alone: all at once."""

        def missing(value: torch.Tensor) -> torch.Tensor:
            return self._ask(named | {name: value}, self._missing)

        change = jvp(missing, (named[name],), (torch.ones_like(named[name]),))[1].detach()
        rows = torch.arange(change.shape[1])
        if name == "gains":
            rows = self.model.trained_inputs.any(dim=1).nonzero().squeeze(-1)
        slope = change.new_zeros(*change.shape, len(rows))
        slope[:, rows, torch.arange(len(rows))] = -change[:, rows]
        return slope

    def _body_slope(self, named: dict[str, torch.Tensor]) -> torch.Tensor:
        """By the bodies' weights: through the torque and through the load that friction grows with."""

        def ten(bodies: torch.Tensor) -> torch.Tensor:
            return self._ask(named | {"bodies": bodies}, lambda model: model.inertial_parameters().flatten())

        change = jacfwd(ten)(named["bodies"]).flatten(1).detach()  # (10 B, weights)
        constants = self._ask(named, lambda model: model.friction.prepared())
        weight = self.data.heavy @ ten(named["bodies"])
        by_load = jvp(
            lambda each: self.model.friction(self.data.qd, each, constants),
            (weight,),
            (torch.ones_like(weight),),
        )[1]
        return ((self.data.rows + by_load.unsqueeze(-1) * self.data.heavy) @ change).detach()


def _data(model: Any, samples: Sequence[DynamicsSamples]) -> _Data:
    taken = [[x[::EVERY] for x in (each.q, each.qd, each.qdd, each.tau)] for each in samples]
    q, qd, qdd, tau = (torch.from_numpy(np.concatenate(columns)) for columns in zip(*taken, strict=True))
    still = torch.zeros_like(q)
    with torch.no_grad():
        rows, heavy = model.regressor(q, qd, qdd), model.regressor(q, still, still)
    return _Data(qd, qdd, tau, rows, heavy)
