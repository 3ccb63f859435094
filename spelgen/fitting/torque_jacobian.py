"""The torque that rigid bodies miss on samples, and its derivative by all weights, block by block."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch.autograd import grad as gradient
from torch.autograd.functional import jacobian
from torch.func import functional_call

from spelgen.fitting.body_steps import moved_bodies
from spelgen.fitting.torque_samples import Block, TorqueSamples
from spelgen.settings.fits import Adaptation

if TYPE_CHECKING:
    from spelgen.emission.loading import EmittedModel

BLOCK = 2**13  # samples at a time: of seven joints some 100 MB with their derivatives
HELD = 2e8  # bytes of regressors up to which they are kept from pass to pass
BODIES = "bodies.raw"
COMPENSATION = "raw_friction_compensation"
GAINS = "raw_gains"  # logarithms of gains between logged and joint torques
FRICTION = ("friction.", "raw_offset")  # what changes from day to day
RESIDUALS = ("joint_functions.", "residual_")  # what stands beside rigid bodies

Weights = Mapping[str, torch.Tensor]


@dataclass(frozen=True, eq=False)
class _Samples:
    """Samples (T, n) with the drives' speeds, and the regressors (T, n, 10 B) of torque and of the gravity torque that
    the drives bear. residual: (T, n) torque of what stands beside rigid bodies. factor: (T, n) on friction.
    """

    qd: torch.Tensor
    qdd: torch.Tensor
    tau: torch.Tensor
    z: torch.Tensor | None
    speed: torch.Tensor
    regressor: torch.Tensor
    load_regressor: torch.Tensor
    residual: torch.Tensor
    factor: torch.Tensor


class Left(NamedTuple):
    """Samples (T, n) with the torque that is missing, and friction's at the drives."""

    q: torch.Tensor
    qd: torch.Tensor
    qdd: torch.Tensor
    missing: torch.Tensor
    friction: torch.Tensor


class Asked(torch.nn.Module):
    """Answers questions about a model, so that ``functional_call`` can ask them under other weights."""

    def __init__(self, model: EmittedModel) -> None:
        super().__init__()
        self.model = model

    def forward(self, question: Callable[[Any], Any]) -> Any:
        return question(self.model)


def rigid_weights(model: Any) -> dict[str, torch.Tensor]:
    """The parameters of bodies, drives and friction laws: all but those of residuals."""
    named = model.named_parameters()
    return {name: x.detach() for name, x in named if not name.startswith(RESIDUALS)}


class TorqueJacobian:
    """Of a model of rigid bodies on ``samples``; x is all their weights (K,), flattened one after the other.

    Residuals are taken as they are when this is made.
    """

    def __init__(self, model: EmittedModel, samples: TorqueSamples) -> None:
        self.model: Any = model
        self.samples = samples
        self._asked = Asked(model)
        compensation = {COMPENSATION: model.get_buffer(COMPENSATION)}
        self.weights = {x: y.detach().clone() for x, y in {**rigid_weights(model), **compensation}.items()}
        self.start = torch.cat([x.flatten() for x in self.weights.values()])
        numbers = 2 * samples.count * samples.joints * self.weights[BODIES].numel()
        self._directions, self._direction, self._moved = self._by_joint()
        self._held = [*self._computed()] if 8 * numbers <= HELD else None

    def squares(self, x: torch.Tensor) -> torch.Tensor:
        """Sums of squares (n,) of the missing torque [Nm^2, N^2], as logged where gains are trained."""
        weights = self._named(x)
        parts = [self._logged(weights, each).detach().square().sum(dim=0) for each in self._blocks()]
        return torch.stack(parts).sum(dim=0)

    def per_gain(self, x: torch.Tensor) -> torch.Tensor:
        """What of a joint torque is logged (n,), relative to the start: 1, but where gains are trained."""
        return self._per_gain(self._named(x)).detach()

    def _per_gain(self, weights: Weights) -> torch.Tensor:
        found = torch.ones(self.samples.joints).double()
        trained = [name for name in weights if name.endswith(GAINS)]
        if not trained:
            return found
        change = weights[trained[0]] - self.weights[trained[0]]
        return found.index_put((self.model.input.rows,), (-change).exp())

    def normal_equations(
        self, x: torch.Tensor, noise: torch.Tensor, free: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """J^T J and J^T r of the missing torque r, in units of ``noise`` (n,), by the ``free`` weights (K,)."""
        weights = self._named(x)
        count = int(free.sum())
        curvature, target = torch.zeros(count, count).double(), torch.zeros(count).double()
        for block in self._blocks():
            missing, slope = self._linearised(weights, block)
            slope = (slope / noise[:, None]).flatten(0, 1)[:, free]
            curvature += slope.mT @ slope
            target += slope.mT @ (missing / noise).flatten()
        return curvature, target

    def left(self, x: torch.Tensor) -> Left:
        """What these weights leave, of all samples."""
        weights, parts = self._named(x), []
        dynamics = self.model
        for each, (q, *_) in zip(self._blocks(), self.samples.blocks(BLOCK), strict=True):
            ten = self._ask(weights, lambda model: model.inertial_parameters.flatten())
            constants = self._ask(weights, lambda model: model.friction.prepare())
            friction = dynamics.friction(each.speed, each.load_regressor @ ten, constants, each.z)
            parts.append(Left(q, each.qd, each.qdd, self._missing(weights, each), each.factor * friction))
        return Left(*(torch.cat(column).detach() for column in zip(*parts, strict=True)))

    def torque_deviation(self) -> torch.Tensor:
        """Standard deviations (n,) of the measured torque, as the joints feel it."""
        with torch.no_grad():
            q = next(self.samples.blocks(1))[0]
            return self.samples.torque_deviation(self.model.input_matrix(q)[0], BLOCK)

    def by_velocity(self, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Of the missing torque the slope by velocity (n,) [Nm s/rad, N s/m], how much of its sum of squares this line
        explains (n,), and how large that is, as a root mean square (n,) [Nm, N].
        """
        weights = self._named(x)
        pairs = [(self._missing(weights, each).detach(), each.qd) for each in self._blocks()]
        sums = [torch.stack([tau * qd, qd * qd, tau * tau]).sum(dim=1) for tau, qd in pairs]
        both, speeds, squares = torch.stack(sums).sum(dim=0)
        slope = both / speeds.clamp(min=1e-300)
        size = (slope * both / self.samples.count).sqrt()
        return slope, slope * both / squares.clamp(min=1e-300), size

    def free(self, adapt: Adaptation | None, compensated: torch.Tensor) -> torch.Tensor:
        """Which weights (K,) move: all, or those of an adaptation; compensation of the joints (n,) that have one."""
        moving = {"load": (), "friction": FRICTION}.get(adapt or "", ("",))
        chosen = {
            name: torch.full_like(x, name.startswith(moving), dtype=torch.bool)
            for name, x in self.weights.items()
        }
        if adapt == "load":
            chosen[BODIES][-1] = True
        else:
            chosen[COMPENSATION] = compensated
        return torch.cat([x.flatten() for x in chosen.values()])

    def moved(self, x: torch.Tensor, step: torch.Tensor) -> torch.Tensor:
        """The weights (K,) after a step, which goes straight in the bodies' inertial parameters."""
        named, change = self._named(x), self._named(step)
        parts = [moved_bodies(y, change[k]) if k == BODIES else y + change[k] for k, y in named.items()]
        return torch.cat([part.flatten() for part in parts])

    def write(self, x: torch.Tensor) -> None:
        """Put the weights into the model."""
        named = self._named(x)
        with torch.no_grad():
            for name in rigid_weights(self.model):
                self.model.get_parameter(name).copy_(named[name])
            self.model.get_buffer(COMPENSATION).copy_(named[COMPENSATION])

    def _blocks(self) -> Iterator[_Samples]:
        yield from self._computed() if self._held is None else self._held

    def _computed(self) -> Iterator[_Samples]:
        return map(self._with_regressors, self.samples.blocks(BLOCK))

    def _with_regressors(self, block: Block) -> _Samples:
        q, qd, qdd, tau, z = block
        still = torch.zeros_like(q)
        with torch.no_grad():
            dynamics = self.model
            past = z if z.shape[-1] else None
            load = torch.einsum("jm,tjk->tmk", dynamics.loads, dynamics.regressor(q, still, still))
            speed = qd @ dynamics.motors.mT
            residual = dynamics.residual_torque(q, qd, qdd, dynamics.prepare())
            factor, regressor = dynamics.friction_factor(q), dynamics.regressor(q, qd, qdd)
            return _Samples(qd, qdd, tau, past, speed, regressor, load, residual, factor)

    def _by_joint(self) -> tuple[dict[str, torch.Tensor], torch.Tensor, torch.Tensor]:
        """Directions (D, *shape) of the joints' weights, in each of which one weight of every joint changes, but of
        joints with a coupling only one; of each of these weights (K - 10 B) its direction, and whose torque it moves,
        (K - 10 B, n).
        """
        own = {name: x for name, x in self.weights.items() if name != BODIES}
        moves = (self.model.motors != 0).double()
        turn: list[int] = []  # of a joint, among those that have torques in common
        for coupled in moves @ moves.mT > 0:
            taken = {turn[k] for k in range(len(turn)) if coupled[k]}
            turn.append(next(k for k in range(len(taken) + 1) if k not in taken))
        turns = max(turn) + 1
        total = turns * sum(x[0].numel() for x in own.values())
        found, directions, moved, count = {}, [], [], 0
        for name, x in own.items():
            size = x[0].numel()
            row, weight = torch.arange(len(x)).repeat_interleave(size), torch.arange(size).repeat(len(x))
            joint = self.model.input.rows[row] if name.endswith(GAINS) else row
            direction = count + turns * weight + torch.tensor(turn)[joint]
            each = torch.zeros(total, len(x), size).double()
            each[direction, row, weight] = 1.0
            found[name] = each.reshape(total, *x.shape)
            directions.append(direction)
            moved.append(moves[joint])
            count += turns * size
        return found, torch.cat(directions), torch.cat(moved)

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
            dynamics = model
            prepared, ten = dynamics.prepare(), dynamics.inertial_parameters.flatten()
            load = samples.load_regressor @ ten
            friction = samples.factor * dynamics.friction(samples.speed, load, prepared.friction, samples.z)
            tau = samples.tau - dynamics.torque_offset
            given = dynamics.input.force(load, tau, prepared.input)
            given = given + dynamics.friction_compensation * samples.qd
            missing: torch.Tensor = (
                given - samples.regressor @ ten - samples.qdd @ prepared.armature - samples.residual
            )
            return missing - friction @ dynamics.motors

        return self._ask(weights, missing)

    def _logged(self, weights: Weights, samples: _Samples) -> torch.Tensor:
        """The missing torque in the units of what was logged, (T, n)."""
        return self._missing(weights, samples) * self._per_gain(weights)

    def _linearised(self, weights: Weights, samples: _Samples) -> tuple[torch.Tensor, torch.Tensor]:
        """The missing torque as logged, (T, n), and minus its derivative by the weights, (T, n, K)."""
        missing, joints = self._joint_slope(weights, samples)
        bodies = self._body_slope(weights, samples)
        sizes = [x.numel() for name, x in weights.items() if name != BODIES]
        rest = iter(joints.split(sizes, dim=-1))
        return missing, torch.cat([bodies if name == BODIES else next(rest) for name in weights], dim=-1)

    def _joint_slope(self, weights: Weights, samples: _Samples) -> tuple[torch.Tensor, torch.Tensor]:
        """The missing torque, and minus its derivative by the weights of which each joint has its own, which move its
        own torque alone: one of every joint at once.

        J d is the derivative of J^T v, which is linear in v, by v. That takes reverse passes alone: forward ones go
        through constants too, as zeros whose shapes torch works out in Python, at several times the cost.
        """
        own = {name: x.clone().requires_grad_() for name, x in weights.items() if name != BODIES}
        with torch.enable_grad():
            missing = self._logged({**weights, **own}, samples)
            v = torch.zeros_like(missing, requires_grad=True)
            pulled = gradient(missing, [*own.values()], v, create_graph=True, materialize_grads=True)
        directions = [self._directions[name] for name in own]
        # (directions, T, n)
        changes = gradient(pulled, v, directions, is_grads_batched=True, materialize_grads=True)[0]
        return missing.detach(), -(changes[self._direction] * self._moved[:, None]).permute(1, 2, 0)

    def _body_slope(self, weights: Weights, samples: _Samples) -> torch.Tensor:
        """By the bodies' weights: through the torque and through the load that friction grows with."""

        def ten(bodies: torch.Tensor) -> torch.Tensor:
            question = {**weights, BODIES: bodies}
            return self._ask(question, lambda model: model.inertial_parameters.flatten())

        change = jacobian(ten, weights[BODIES], vectorize=True).flatten(1)  # (10 B, K)
        constants = self._ask(weights, lambda model: model.friction.prepare())
        load = (samples.load_regressor @ ten(weights[BODIES])).detach().requires_grad_()
        with torch.enable_grad():
            friction = self.model.friction(samples.speed, load, constants, samples.z)
        (by_load,) = gradient(friction.sum(), load, materialize_grads=True)  # each drive's by its own load
        at_drives = (samples.factor * by_load).unsqueeze(-1) * samples.load_regressor
        loaded = samples.regressor + torch.einsum("mj,tmk->tjk", self.model.motors, at_drives)
        return ((loaded @ change) * self._per_gain(weights)[:, None]).detach()
