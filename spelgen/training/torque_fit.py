"""Fit a closed-form model to torques: its most probable weights, by Gauss-Newton steps (Levenberg-Marquardt).

The torque is linear in the bodies' parameters, which the log-Cholesky weights make possible ones, and smooth in the
few constants of each joint: seconds are enough, and no step size is to be chosen. What is minimised is

    sum over joints and samples of (missing torque / noise)^2 + sum of (weight - start)^2 / deviation^2,

a Gaussian prior around the URDF's bodies and usual friction. The noise of a joint is what is left of its torque, found
in rounds, and counted once for as many samples as it stays alike (see ``least_squares.deviations``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch.func import functional_call, jacfwd, jvp

from spelgen.identification.least_squares import deviations
from spelgen.identification.samples import DynamicsSamples

if TYPE_CHECKING:
    from spelgen.training.runs import EmittedModel

EVERY = 2  # samples taken of so many: filtered at 8 Hz and sampled at 100 Hz they say all that is to be said
ROUNDS = 6  # of weighing joints by what is left of their torque
STEPS = 8  # at most in a round
GAIN = 1e-4  # relative: a step that gains less ends a round
LEAST_NOISE = 0.02  # of a joint's torque range: few samples may be fitted better than the model deserves
DAMPING = (1e-9, 1e-3, 1e6)  # of the steps, relative to the curvature: least, first, most


@dataclass(frozen=True)
class Belief:
    """Standard deviations of the weights around their start; each is a logarithm or a share, so they have no unit.

    bodies: in the affine-invariant metric, 0.1 is about 20 % in mass. offset: in usual sizes of friction.
    """

    bodies: float = 0.5
    rotor: float = 1.5
    sizes: float = 1.5
    speeds: float = 0.7
    offset: float = 0.5
    gains: float = 0.3

    def of(self, name: str) -> float:
        """The deviation of the weights called ``name``, as in ``named_parameters``."""
        last = name.rsplit(".", 1)[-1]
        if last in ("bodies", "rotor", "offset", "gains"):
            return float(getattr(self, last))
        return self.speeds if last in ("bend_speed", "fading", "jump") else self.sizes


@dataclass(frozen=True, eq=False)
class TorqueFit:
    """How a fit ended. noise: (n,) of each joint, as if independent [Nm, N]; residual: (n,) root mean square."""

    noise: np.ndarray
    residual: np.ndarray
    steps: int
    cost: float


def fit_torque(
    model: EmittedModel,
    samples: Sequence[DynamicsSamples],
    belief: Belief | None = None,
    only: Sequence[str] = (),
    bodies: Sequence[int] = (),
) -> TorqueFit:
    """Set the weights of a closed-form ``model`` to the most probable ones after ``samples``.

    The prior is centred on the weights as they are. ``only``: names of the weights that may move, all by default;
    ``bodies``: of the bodies, which; all by default.
    """
    problem = _Problem(model, samples, belief or Belief(), only, bodies)
    x = problem.start
    left = problem.missing(x)
    noise = problem.noise(left) if only else 0.1 * problem.range
    damping, steps, cost = DAMPING[1], 0, float("inf")
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
    return TorqueFit(noise.numpy(), left.square().mean(dim=0).sqrt().numpy(), steps, cost)


class _Torque(torch.nn.Module):
    """The torque that a model misses at samples whose regressors are known."""

    def __init__(self, model: EmittedModel) -> None:
        super().__init__()
        self.model: Any = model

    def forward(self, data: _Data) -> torch.Tensor:
        model = self.model
        prepared = model.prepare()
        ten = model.inertial_parameters().flatten()
        friction = model.friction(data.qd, data.heavy @ ten, prepared.friction)
        given = (data.tau - model.torque_offset()) @ prepared.input.mT
        return given - data.rows @ ten - prepared.rotors * data.qdd - friction


@dataclass(frozen=True, eq=False)
class _Data:
    """All samples (T, n), and the regressors (T, n, 10 B) of torque and of gravity torque at them."""

    qd: torch.Tensor
    qdd: torch.Tensor
    tau: torch.Tensor
    rows: torch.Tensor
    heavy: torch.Tensor
    ends: tuple[int, ...] = field(default=())


class _Problem:
    def __init__(
        self,
        model: EmittedModel,
        samples: Sequence[DynamicsSamples],
        belief: Belief,
        only: Sequence[str],
        bodies: Sequence[int],
    ) -> None:
        self.model: Any = model
        self.torque = _Torque(model)
        self.data = _data(model, samples)
        self.weights = {name: x.detach().clone() for name, x in model.named_parameters()}
        self.names = [name for name in self.weights if not only or name in only]
        free = []
        for name in self.names:
            mask = torch.ones_like(self.weights[name], dtype=torch.bool)
            if name == "bodies" and bodies:
                mask[:] = False
                mask[list(bodies)] = True
            free.append(mask.flatten())
        self.free = torch.cat(free)
        self.start = torch.cat([self.weights[name].flatten() for name in self.names])
        spread = [torch.full_like(self.weights[name], belief.of(name)).flatten() for name in self.names]
        self.precision = torch.cat(spread).pow(-2)
        given = self.data.tau @ model.prepare().input.mT.detach()
        spread_ = given.std(dim=0)
        self.range = torch.maximum(spread_, 1e-3 * spread_.max())

    def missing(self, x: torch.Tensor) -> torch.Tensor:
        """(T, n)."""
        return functional_call(self.torque, self._named(x), (self.data,)).detach()

    def noise(self, left: torch.Tensor) -> torch.Tensor:
        """(n,)."""
        parts = np.split(left.numpy(), self.data.ends)
        return torch.maximum(torch.from_numpy(deviations(parts, 0)), LEAST_NOISE * self.range)

    def cost(self, x: torch.Tensor, left: torch.Tensor, noise: torch.Tensor) -> float:
        away = (self.precision * (x - self.start).square()).sum()
        return float(((left / noise).square().sum() + away) / 2)

    def step(
        self, x: torch.Tensor, left: torch.Tensor, noise: torch.Tensor, cost: float, damping: float
    ) -> tuple[torch.Tensor, torch.Tensor, float, float] | None:
        """Weights, missing torque, cost and damping after a step that lowers the cost; None: there is none."""
        slope = (self._slope(x) / noise[:, None]).flatten(0, 1)[:, self.free]
        precision = self.precision[self.free]
        curvature = slope.mT @ slope + torch.diag(precision)
        target = slope.mT @ (left / noise).flatten() - precision * (x - self.start)[self.free]
        while damping < DAMPING[2]:
            moved = x.clone()
            moved[self.free] += torch.linalg.solve(
                curvature + damping * torch.diag(curvature.diagonal()), target
            )
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
                parameter.copy_(named[f"model.{name}"])

    def _named(self, x: torch.Tensor) -> dict[str, torch.Tensor]:
        named = dict(self.weights)
        parts = x.split([self.weights[name].numel() for name in self.names])
        named |= {
            name: part.view_as(self.weights[name]) for name, part in zip(self.names, parts, strict=True)
        }
        return {f"model.{name}": value for name, value in named.items()}

    def _slope(self, x: torch.Tensor) -> torch.Tensor:
        """Minus d(missing torque) / d(weights), (T, n, weights)."""
        named = self._named(x)
        parts = [
            self._body_slope(named) if name == "bodies" else self._own(named, name) for name in self.names
        ]
        return torch.cat(parts, dim=-1)

    def _own(self, named: dict[str, torch.Tensor], name: str) -> torch.Tensor:
        """Of weights of which each joint has its own: all at once."""
        key = f"model.{name}"

        def missing(value: torch.Tensor) -> torch.Tensor:
            return functional_call(self.torque, named | {key: value}, (self.data,))

        change = jvp(missing, (named[key],), (torch.ones_like(named[key]),))[1].detach()
        rows = torch.arange(change.shape[1])
        if name == "gains":
            rows = self.model.trained_inputs.any(dim=1).nonzero().squeeze(-1)
        slope = change.new_zeros(*change.shape, len(rows))
        slope[:, rows, torch.arange(len(rows))] = -change[:, rows]
        return slope

    def _body_slope(self, named: dict[str, torch.Tensor]) -> torch.Tensor:
        model, data = self.model, self.data
        own = {key.removeprefix("model."): value for key, value in named.items()}
        parameters = _Parameters(model)

        def ten(bodies: torch.Tensor) -> torch.Tensor:
            return functional_call(parameters, named | {"model.bodies": bodies}, ())

        change = jacfwd(ten)(own["bodies"]).flatten(1).detach()  # (10 B, weights)
        constants = functional_call(_Constants(model), named, ())
        weight = data.heavy @ ten(own["bodies"])
        load = jvp(lambda w: model.friction(data.qd, w, constants), (weight,), (torch.ones_like(weight),))[1]
        return ((data.rows + load.unsqueeze(-1) * data.heavy) @ change).detach()


class _Parameters(torch.nn.Module):
    def __init__(self, model: EmittedModel) -> None:
        super().__init__()
        self.model: Any = model

    def forward(self) -> torch.Tensor:
        ten: torch.Tensor = self.model.inertial_parameters()
        return ten.flatten()


class _Constants(torch.nn.Module):
    def __init__(self, model: EmittedModel) -> None:
        super().__init__()
        self.model: Any = model

    def forward(self) -> Any:
        return self.model.prepare().friction


def _data(model: EmittedModel, samples: Sequence[DynamicsSamples]) -> _Data:
    taken = [[x[::EVERY] for x in (s.q, s.qd, s.qdd, s.tau)] for s in samples]
    q, qd, qdd, tau = (torch.from_numpy(np.concatenate(columns)) for columns in zip(*taken, strict=True))
    still = torch.zeros_like(q)
    regressor: Any = getattr(model, "regressor")  # noqa: B009
    with torch.no_grad():
        rows, heavy = regressor(q, qd, qdd), regressor(q, still, still)
    return _Data(qd, qdd, tau, rows, heavy, tuple(np.cumsum([len(x[0]) for x in taken])[:-1].tolist()))
