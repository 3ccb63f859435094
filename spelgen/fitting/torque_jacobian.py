"""The torque that a closed-form model misses on samples, and its derivative by all weights, block by block."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch
from torch.func import functional_call, jacfwd, jvp

from spelgen.fitting.torque_samples import Block, TorqueSamples

if TYPE_CHECKING:
    from spelgen.emission.loading import EmittedModel

BLOCK = 2**13  # samples at a time: of seven joints some 100 MB with their derivatives
HELD = 2e8  # bytes of regressors up to which they are kept from pass to pass
BODIES = "dynamics.inertial_parameters.raw"

Weights = Mapping[str, torch.Tensor]


@dataclass(frozen=True, eq=False)
class _Samples:
    """Samples (T, n), and the regressors (T, n, 10 B) of torque and of gravity torque at them."""

    qd: torch.Tensor
    qdd: torch.Tensor
    tau: torch.Tensor
    z: torch.Tensor | None
    regressor: torch.Tensor
    gravity_regressor: torch.Tensor


class _Asked(torch.nn.Module):
    """Answers questions about a model, so that ``functional_call`` can ask them under other weights."""

    def __init__(self, model: EmittedModel) -> None:
        super().__init__()
        self.model = model

    def forward(self, question: Callable[[Any], Any]) -> Any:
        return question(self.model)


class TorqueJacobian:
    """Of a closed-form ``model`` on ``samples``; x is all weights (K,), flattened one after the other."""

    def __init__(self, model: EmittedModel, samples: TorqueSamples) -> None:
        self.model: Any = model
        self.samples = samples
        self._asked = _Asked(model)
        self.weights = {name: x.detach().clone() for name, x in model.named_parameters()}
        self.start = torch.cat([x.flatten() for x in self.weights.values()])
        numbers = 2 * samples.count * samples.joints * self.weights[BODIES].numel()
        self._held = [*self._computed()] if 8 * numbers <= HELD else None

    def squares(self, x: torch.Tensor) -> torch.Tensor:
        """Sums of squares (n,) of the missing torque [Nm^2, N^2]."""
        weights = self._named(x)
        parts = [self._missing(weights, each).detach().square().sum(dim=0) for each in self._blocks()]
        return torch.stack(parts).sum(dim=0)

    def normal_equations(
        self, x: torch.Tensor, noise: torch.Tensor, free: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """J^T J and J^T r of the missing torque r, in units of ``noise`` (n,), by the ``free`` weights (K,)."""
        weights = self._named(x)
        count = int(free.sum())
        curvature, target = torch.zeros(count, count).double(), torch.zeros(count).double()
        for block in self._blocks():
            slope = (self._slope(weights, block) / noise[:, None]).flatten(0, 1)[:, free]
            curvature += slope.mT @ slope
            target += slope.mT @ (self._missing(weights, block).detach() / noise).flatten()
        return curvature, target

    def torque_deviation(self) -> torch.Tensor:
        """Standard deviations (n,) of the measured torque, as the joints feel it."""
        with torch.no_grad():
            q = next(self.samples.blocks(1))[0]
            return self.samples.torque_deviation(self.model.input_matrix(q)[0], BLOCK)

    def free(self, only_bodies: Sequence[int] | None) -> torch.Tensor:
        """Which weights (K,) move: all, or those of some bodies."""
        if only_bodies is None:
            return torch.ones_like(self.start, dtype=torch.bool)
        chosen = {name: torch.zeros_like(x, dtype=torch.bool) for name, x in self.weights.items()}
        chosen[BODIES][list(only_bodies)] = True
        return torch.cat([x.flatten() for x in chosen.values()])

    def write(self, x: torch.Tensor) -> None:
        """Put the weights into the model."""
        named = self._named(x)
        with torch.no_grad():
            for name, parameter in self.model.named_parameters():
                parameter.copy_(named[name])

    def _blocks(self) -> Iterator[_Samples]:
        yield from self._computed() if self._held is None else self._held

    def _computed(self) -> Iterator[_Samples]:
        return map(self._with_regressors, self.samples.blocks(BLOCK))

    def _with_regressors(self, block: Block) -> _Samples:
        q, qd, qdd, tau, z = block
        still = torch.zeros_like(q)
        with torch.no_grad():
            regressor = self.model.dynamics.regressor
            past = z if z.shape[-1] else None
            return _Samples(qd, qdd, tau, past, regressor(q, qd, qdd), regressor(q, still, still))

    def _named(self, x: torch.Tensor) -> dict[str, torch.Tensor]:
        parts = x.split([weight.numel() for weight in self.weights.values()])
        return {
            name: part.view_as(weight)
            for (name, weight), part in zip(self.weights.items(), parts, strict=True)
        }

    def _ask(self, weights: Weights, question: Callable[[Any], Any]) -> Any:
        return functional_call(self._asked, {f"model.{name}": x for name, x in weights.items()}, (question,))

    def _missing(self, weights: Weights, samples: _Samples) -> torch.Tensor:
        """The torque that the model does not explain, (T, n)."""

        def missing(model: Any) -> torch.Tensor:
            dynamics = model.dynamics
            prepared, ten = dynamics.prepare(), dynamics.inertial_parameters().flatten()
            weight = samples.gravity_regressor @ ten
            friction = dynamics.friction(samples.qd, weight, prepared.friction, samples.z)
            tau = samples.tau - dynamics.torque_offset()
            given: torch.Tensor = dynamics.input.force(weight, tau, prepared.input)
            return given - samples.regressor @ ten - prepared.armature * samples.qdd - friction

        return self._ask(weights, missing)

    def _slope(self, weights: Weights, samples: _Samples) -> torch.Tensor:
        """Minus d(missing torque) / d(weights), (T, n, K)."""
        parts = [
            self._body_slope(weights, samples)
            if name == BODIES
            else self._joint_slope(weights, samples, name)
            for name in weights
        ]
        return torch.cat(parts, dim=-1)

    def _joint_slope(self, weights: Weights, samples: _Samples, name: str) -> torch.Tensor:
        """By weights of which each joint has its own, which move its own torque alone: all at once."""

        def missing(value: torch.Tensor) -> torch.Tensor:
            return self._missing({**weights, name: value}, samples)

        value = weights[name]
        if name.endswith("raw_gains"):
            joints = self.model.dynamics.input.rows
        else:
            joints = torch.arange(len(value)).repeat_interleave(value[0].numel())
        several = value.reshape(len(value), -1)
        # one weight of every joint at a time
        each = [
            (torch.arange(several.shape[1]) == k).double().expand_as(several) for k in range(several.shape[1])
        ]
        changes = [jvp(missing, (value,), (one.reshape_as(value),))[1].detach() for one in each]
        change = torch.stack(changes, dim=-1)  # (T, n, weights of a joint)
        slope = change.new_zeros(*change.shape[:2], value.numel())
        columns = torch.arange(value.numel())
        slope[:, joints, columns] = -change[:, joints, columns % several.shape[1]]
        return slope

    def _body_slope(self, weights: Weights, samples: _Samples) -> torch.Tensor:
        """By the bodies' weights: through the torque and through the load that friction grows with."""

        def ten(bodies: torch.Tensor) -> torch.Tensor:
            question = {**weights, BODIES: bodies}
            return self._ask(question, lambda model: model.dynamics.inertial_parameters().flatten())

        change = jacfwd(ten)(weights[BODIES]).flatten(1).detach()  # (10 B, K)
        constants = self._ask(weights, lambda model: model.dynamics.friction.prepare())
        weight = samples.gravity_regressor @ ten(weights[BODIES])
        by_load = jvp(
            lambda each: self.model.dynamics.friction(samples.qd, each, constants, samples.z),
            (weight,),
            (torch.ones_like(weight),),
        )[1]
        loaded = samples.regressor + by_load.unsqueeze(-1) * samples.gravity_regressor
        return (loaded @ change).detach()
