"""The torque that rigid bodies miss on samples, and its derivative by all weights, block by block."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch.autograd import grad as gradient
from torch.autograd.functional import jacobian

from spelgen.dynamics.body_regressor import regressor_of
from spelgen.dynamics.parameters import parameter_table
from spelgen.dynamics.residuals import friction_factor, residual_torque
from spelgen.fitting.body_steps import moved_bodies
from spelgen.fitting.functional_model import FunctionalModel, Weights
from spelgen.fitting.torque_samples import Block, TorqueSamples
from spelgen.settings.fits import Adaptation
from spelgen.settings.tuning.fitting import TorqueTuning

if TYPE_CHECKING:
    from spelgen.emission.loading import EmittedModel

TUNING = TorqueTuning()

RIGID = (
    "bodies", "friction_compensation", "gains", "armature", "offset", "sizes", "velocities", "load_dependence",
    "fractions",
)  # fmt: skip
"""Kinds of parameters of bodies, drives and friction laws: all but what stands beside them."""
DAILY = ("sizes", "velocities", "load_dependence", "fractions", "offset")  # kinds that change from day to day


@dataclass(frozen=True, eq=False)
class _Samples:
    """Samples (T, n) with the drives' speeds, and the regressors (T, n, 10 B) of torque and of the gravity torque that
    the drives bear. residual: (T, n) torque of what stands beside rigid bodies. factor: (T, n) on friction.
    direction: (T, n) of dry friction without memory; None: as the speed has it.
    """

    q: torch.Tensor
    qd: torch.Tensor
    qdd: torch.Tensor
    tau: torch.Tensor
    z: torch.Tensor | None
    direction: torch.Tensor | None
    speed: torch.Tensor
    regressor: torch.Tensor
    load_regressor: torch.Tensor
    residual: torch.Tensor
    factor: torch.Tensor


class ResidualSamples(NamedTuple):
    """Samples (T, n) with the torque that is missing, and friction's at the drives."""

    q: torch.Tensor
    qd: torch.Tensor
    qdd: torch.Tensor
    missing: torch.Tensor
    friction: torch.Tensor


@dataclass(frozen=True, eq=False)
class _Directions:
    """Directions in which one weight of every joint changes at once, but of joints with a coupling only one.

    by_name: (D, *shape) changes of the weights of each name. of_weight: (K',) the direction of each weight.
    moves: (K', n) whose torques each weight moves.
    """

    by_name: dict[str, torch.Tensor]
    of_weight: torch.Tensor
    moves: torch.Tensor


class RigidWeights:
    """The weights of bodies, drives and friction laws of a model, by name, and what they stand for."""

    def __init__(self, model: EmittedModel) -> None:
        self.model = model
        self.kinds = {name: x.kind for name, x in parameter_table(model).items() if x.kind in RIGID}
        (self.bodies,) = self.of_kind("bodies")
        (self.compensation,) = self.of_kind("friction_compensation")
        self.start = {name: self._tensor(name).detach().clone() for name in self.kinds}
        self.sizes = [weight.numel() for weight in self.start.values()]

    def of_kind(self, *kinds: str) -> list[str]:
        """Return the names of weights of these kinds."""
        return [name for name, kind in self.kinds.items() if kind in kinds]

    def named(self, x: torch.Tensor) -> dict[str, torch.Tensor]:
        """Return the weights by name, of all of them flattened one after the other (K,)."""
        parts = zip(self.start.items(), x.split(self.sizes), strict=True)
        return {name: part.view_as(weight) for (name, weight), part in parts}

    def write(self, x: torch.Tensor) -> None:
        """Put weights (K,) into the model."""
        with torch.no_grad():
            for name, weight in self.named(x).items():
                self._tensor(name).copy_(weight)

    def _tensor(self, name: str) -> torch.Tensor:
        """Return a parameter, or a buffer that a fit may set."""
        module, _, attribute = name.rpartition(".")
        tensor: torch.Tensor = getattr(self.model.get_submodule(module), attribute)
        return tensor


class TorqueJacobian:
    """Of a model of rigid bodies on ``samples``; x is all their weights (K,), flattened one after the other.

    Residuals beside bodies are taken as they are when this is made.
    """

    def __init__(self, model: EmittedModel, samples: TorqueSamples) -> None:
        self.model: Any = model
        self.samples = samples
        self.rigid = RigidWeights(model)
        self.start = torch.cat([weight.flatten() for weight in self.rigid.start.values()])
        self._functional = FunctionalModel(model)
        self._directions = self._by_joint()
        self._cached: list[_Samples] | None = None
        numbers = 2 * samples.count * samples.joints * self.rigid.start[self.rigid.bodies].numel()
        if 8 * numbers <= TUNING.cached_bytes:
            self._cached = list(self._computed())

    def squares(self, x: torch.Tensor) -> torch.Tensor:
        """Return sums of squares (n,) of the missing torque [Nm^2, N^2], as logged where gains are trained."""
        weights = self.rigid.named(x)
        total = torch.zeros(self.samples.joints).double()
        for block in self._blocks():
            total += self._logged(weights, block).detach().square().sum(dim=0)
        return total

    def per_gain(self, x: torch.Tensor) -> torch.Tensor:
        """Return what of a joint torque is logged (n,), relative to the start: 1, but where gains are trained."""
        return self._per_gain(self.rigid.named(x)).detach()

    def _per_gain(self, weights: Weights) -> torch.Tensor:
        ones = torch.ones(self.samples.joints).double()
        for name in self.rigid.of_kind("gains"):  # logarithms of gains between logged and joint torques
            change = weights[name] - self.rigid.start[name]
            return ones.index_put((self.model.gain_rows,), (-change).exp())
        return ones

    def normal_equations(
        self, x: torch.Tensor, noise: torch.Tensor, free: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return J^T J and J^T r of the missing torque r, in units of ``noise`` (n,), by the ``free`` weights (K,)."""
        weights = self.rigid.named(x)
        count = int(free.sum())
        curvature, descent = torch.zeros(count, count).double(), torch.zeros(count).double()
        for block in self._blocks():
            missing, slope = self._linearised(weights, block)
            slope = (slope / noise[:, None]).flatten(0, 1)[:, free]
            curvature += slope.mT @ slope
            descent += slope.mT @ (missing / noise).flatten()
        return curvature, descent

    def residual_samples(self, x: torch.Tensor) -> ResidualSamples:
        """Return what these weights leave of the torque, of all samples."""
        weights, blocks = self.rigid.named(x), []
        for block in self._blocks():
            friction = block.factor * self._friction(weights, block, self._load(weights, block))
            missing = self._missing(weights, block)
            blocks.append(ResidualSamples(block.q, block.qd, block.qdd, missing, friction))
        return ResidualSamples(*(torch.cat(column).detach() for column in zip(*blocks, strict=True)))

    def torque_deviation(self) -> torch.Tensor:
        """Return standard deviations (n,) of the measured torque, as the joints feel it."""
        with torch.no_grad():
            q = next(self.samples.blocks(1))[0]
            return self.samples.torque_deviation(self.model.input_matrix(q)[0], TUNING.block)

    def by_velocity(self, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return of the missing torque the slope by velocity (n,) [Nm s/rad, N s/m], how much of its sum of squares
        this line explains (n,), and how large that is, as a root mean square (n,) [Nm, N].
        """
        weights = self.rigid.named(x)
        sums = torch.zeros(3, self.samples.joints).double()
        for block in self._blocks():
            tau, qd = self._missing(weights, block).detach(), block.qd
            sums += torch.stack([tau * qd, qd * qd, tau * tau]).sum(dim=1)
        products, speeds, squares = sums
        slope = products / speeds.clamp(min=1e-300)
        size = (slope * products / self.samples.count).sqrt()
        return slope, slope * products / squares.clamp(min=1e-300), size

    def free(self, adapt: Adaptation | None, compensated: torch.Tensor) -> torch.Tensor:
        """Return which weights (K,) move: all, or those of an adaptation; compensation of the joints (n,) that have
        one.
        """
        kinds = {"load": (), "friction": DAILY}.get(adapt or "", RIGID)
        masks = {}
        for name, weight in self.rigid.start.items():
            masks[name] = torch.full_like(weight, self.rigid.kinds[name] in kinds, dtype=torch.bool)
        if adapt == "load":
            masks[self.rigid.bodies][-1] = True
        else:
            masks[self.rigid.compensation] = compensated
        return torch.cat([mask.flatten() for mask in masks.values()])

    def moved(self, x: torch.Tensor, step: torch.Tensor) -> torch.Tensor:
        """Return the weights (K,) after a step, which goes straight in the bodies' inertial parameters."""
        change, bodies = self.rigid.named(step), self.rigid.bodies
        weights = self.rigid.named(x + step)
        moved = moved_bodies(self.rigid.named(x)[bodies], change[bodies])
        # bodies that stay keep their last digit, too
        weights[bodies] = torch.where(change[bodies].any(dim=-1, keepdim=True), moved, weights[bodies])
        return torch.cat([weight.flatten() for weight in weights.values()])

    def write(self, x: torch.Tensor) -> None:
        """Put the weights into the model."""
        self.rigid.write(x)

    def _blocks(self) -> Iterator[_Samples]:
        if self._cached is None:
            return self._computed()
        return iter(self._cached)

    def _computed(self) -> Iterator[_Samples]:
        return map(self._with_regressors, self.samples.blocks(TUNING.block))

    def _with_regressors(self, block: Block) -> _Samples:
        q, qd, qdd, tau, z = block
        rest = torch.zeros_like(q)
        model = self.model
        elements, columns = model.elements, z.shape[-1]
        with torch.no_grad():
            gravity_regressor = regressor_of(model.chain, q, rest, rest)
            return _Samples(
                q=q,
                qd=qd,
                qdd=qdd,
                tau=tau,
                z=z[..., :elements] if columns else None,
                direction=z[..., elements] if columns > elements else None,
                speed=qd @ model.motors.mT,
                regressor=regressor_of(model.chain, q, qd, qdd),
                load_regressor=torch.einsum("jm,tjk->tmk", model.loads, gravity_regressor),
                residual=residual_torque(model, q, qd, qdd),
                factor=friction_factor(model, q),
            )

    def _by_joint(self) -> _Directions:
        """Return the directions of all weights but those of bodies."""
        moves = (self.model.motors != 0).double()
        colour = torch.tensor(_colours(moves @ moves.mT > 0))
        colours = int(colour.max()) + 1
        weights = {name: x for name, x in self.rigid.start.items() if name != self.rigid.bodies}
        total = colours * sum(weight[0].numel() for weight in weights.values())
        by_name, of_weight, moved, count = {}, [], [], 0
        for name, weight in weights.items():
            size = weight[0].numel()
            row = torch.arange(len(weight)).repeat_interleave(size)
            column = torch.arange(size).repeat(len(weight))
            joint = row
            if self.rigid.kinds[name] == "gains":
                joint = self.model.gain_rows[row]
            direction = count + colours * column + colour[joint]
            changes = torch.zeros(total, len(weight), size).double()
            changes[direction, row, column] = 1.0
            by_name[name] = changes.reshape(total, *weight.shape)
            of_weight.append(direction)
            moved.append(moves[joint])
            count += colours * size
        return _Directions(by_name, torch.cat(of_weight), torch.cat(moved))

    def _inertial_parameters(self, weights: Weights) -> torch.Tensor:
        """Return the ten parameters of all bodies (10 B,)."""
        parameters: torch.Tensor = self._functional.under(
            weights, lambda model: model.inertial_parameters.flatten()
        )
        return parameters

    def _load(self, weights: Weights, samples: _Samples) -> torch.Tensor:
        """Return the gravity torque that the drives bear (T, n)."""
        return samples.load_regressor @ self._inertial_parameters(weights)

    def _friction(self, weights: Weights, samples: _Samples, load: torch.Tensor) -> torch.Tensor:
        """Return friction's torque at the drives (T, n), as its laws alone have it."""
        constants = self._functional.under(weights, lambda model: model.friction.prepare())
        friction: torch.Tensor = self.model.friction(
            samples.speed, load, constants, samples.z, samples.direction
        )
        return friction

    def _missing(self, weights: Weights, samples: _Samples) -> torch.Tensor:
        """Return the torque that the model does not explain (T, n)."""

        def missing(model: Any) -> torch.Tensor:
            prepared, parameters = model.prepare(), model.inertial_parameters.flatten()
            load = samples.load_regressor @ parameters
            friction = model.friction(samples.speed, load, prepared.friction, samples.z, samples.direction)
            friction = samples.factor * friction
            force = model.input_force(None, samples.qd, samples.tau, prepared)
            inertial = samples.regressor @ parameters + samples.qdd @ prepared.armature
            difference: torch.Tensor = force - inertial - samples.residual - friction @ model.motors
            return difference

        torque: torch.Tensor = self._functional.under(weights, missing)
        return torque

    def _logged(self, weights: Weights, samples: _Samples) -> torch.Tensor:
        """Return the missing torque in the units of what was logged (T, n)."""
        return self._missing(weights, samples) * self._per_gain(weights)

    def _linearised(self, weights: Weights, samples: _Samples) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the missing torque as logged (T, n), and minus its derivative by the weights (T, n, K)."""
        bodies = self.rigid.bodies
        missing, joint_slopes = self._joint_slope(weights, samples)
        names = [name for name in weights if name != bodies]
        sizes = [weights[name].numel() for name in names]
        slopes = dict(zip(names, joint_slopes.split(sizes, dim=-1), strict=True))
        slopes[bodies] = self._body_slope(weights, samples)
        return missing, torch.cat([slopes[name] for name in weights], dim=-1)

    def _joint_slope(self, weights: Weights, samples: _Samples) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the missing torque, and minus its derivative by the weights of which each joint has its own, which
        move its own torque alone: one of every joint at once.

        J d is the derivative of J^T v, which is linear in v, by v. That takes reverse passes alone: forward ones go
        through constants too, as zeros whose shapes torch works out in Python, at several times the cost.
        """
        leaves = {name: weights[name].clone().requires_grad_() for name in self._directions.by_name}
        with torch.enable_grad():
            missing = self._logged({**weights, **leaves}, samples)
            v = torch.zeros_like(missing, requires_grad=True)
            products = gradient(missing, list(leaves.values()), v, create_graph=True, materialize_grads=True)
        directions = list(self._directions.by_name.values())
        # (directions, T, n)
        changes = gradient(products, v, directions, is_grads_batched=True, materialize_grads=True)[0]
        slopes = changes[self._directions.of_weight] * self._directions.moves[:, None]
        return missing.detach(), -slopes.permute(1, 2, 0)

    def _body_slope(self, weights: Weights, samples: _Samples) -> torch.Tensor:
        """Return minus the derivative by the bodies' weights: through the torque, and through the load that friction
        grows with.
        """
        name = self.rigid.bodies

        def parameters(bodies: torch.Tensor) -> torch.Tensor:
            return self._inertial_parameters({**weights, name: bodies})

        change = jacobian(parameters, weights[name], vectorize=True).flatten(1)  # (10 B, K)
        load = self._load(weights, samples).detach().requires_grad_()
        with torch.enable_grad():
            friction = self._friction(weights, samples, load)
        (by_load,) = gradient(friction.sum(), load, materialize_grads=True)  # each drive's by its own load
        at_drives = (samples.factor * by_load).unsqueeze(-1) * samples.load_regressor
        loaded = samples.regressor + torch.einsum("mj,tmk->tjk", self.model.motors, at_drives)
        result: torch.Tensor = ((loaded @ change) * self._per_gain(weights)[:, None]).detach()
        return result


def _colours(coupled: torch.Tensor) -> list[int]:
    """Return a number for each joint, another one than of all before it that it is coupled with (n, n)."""
    colours: list[int] = []
    for row in coupled.tolist():
        used = {colour for colour, shared in zip(colours, row, strict=False) if shared}
        colour = 0
        while colour in used:
            colour += 1
        colours.append(colour)
    return colours
