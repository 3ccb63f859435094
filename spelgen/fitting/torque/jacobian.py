"""The torque that rigid bodies miss on samples, and its normal equations by all weights, block by block."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch.autograd import grad as gradient

from spelgen.dynamics.body_regressor import regressor_of
from spelgen.dynamics.residuals import friction_factor, residual_torque
from spelgen.fitting.functional_model import FunctionalModel, Weights
from spelgen.fitting.torque.body_steps import moved_bodies
from spelgen.fitting.torque.samples import Block, TorqueSamples
from spelgen.fitting.torque.weights import RigidWeights
from spelgen.settings.tuning.fitting import TorqueTuning
from spelgen.settings.tuning.identification import IdentificationTuning

if TYPE_CHECKING:
    from spelgen.emission.loading import EmittedModel

TUNING = TorqueTuning()
MOVING = IdentificationTuning().moving
LOGARITHMS = ("armature", "sizes", "load_dependence")


@dataclass(frozen=True, eq=False)
class _Samples:
    """Samples (T, n) with the drives' speeds, and the regressors (T, n, 10 B) of torque and of the gravity torque that
    the drives bear. residual: (T, n) torque of what stands beside rigid bodies. factor: (T, n) on friction.
    direction: (T, n) of dry friction without memory; None: as the speed has it.
    """

    measured: Block
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


class RigidResponse(NamedTuple):
    """How bodies, drives and friction laws follow a torque on each joint.

    slopes: J (T, C) by the C weights that move its torque. gains: what a fit of these makes of J^T torque (C, C).
    """

    slopes: tuple[torch.Tensor, ...]
    gains: tuple[torch.Tensor, ...]

    def remaining(self, joint: int, torque: torch.Tensor) -> torch.Tensor:
        """Return what of torques (T, P) on a joint is left when these weights have taken over what they can."""
        slope = self.slopes[joint]
        return torque - slope @ (self.gains[joint] @ (slope.mT @ torque))


@dataclass(frozen=True, eq=False)
class _Directions:
    """Directions in which one weight of every joint changes at once, but of joints with a coupling only one.

    by_name: of each name changes (D, *shape) of its weights. of_weight: (K,) the direction of each weight, -1 of
    those of bodies. moves: (K, n) whose torques each weight moves.
    """

    by_name: dict[str, torch.Tensor]
    of_weight: torch.Tensor
    moves: torch.Tensor


class TorqueJacobian:
    """Of a model of rigid bodies on ``samples``; x is all their weights (K,), flattened one after the other.

    Residuals beside bodies are taken as they are when this is made.
    """

    def __init__(self, model: EmittedModel, samples: TorqueSamples) -> None:
        self.model: Any = model
        self.samples = samples
        self.rigid = RigidWeights(model)
        self.start = self.rigid.flattened(self.rigid.start)
        self._functional = FunctionalModel(model)
        self._directions = self._by_joint()
        self._blocks = [self._with_regressors(block) for block in samples.blocks(TUNING.block)]

    def start_by_torque(self) -> torch.Tensor:
        """Return the weights (K,) as they are, with no friction larger than the deviation of its drive's torque."""
        weights, motors, speed = self.rigid.named(self.start), self.model.motors, self.samples.columns.qd
        deviation = (self._joint_torque() @ torch.linalg.inv(motors)).std(dim=0)
        # a drive that stands still, or gives no torque, shows no friction
        bounded = (deviation > 0) & ((speed @ motors.mT).abs().amax(dim=0) > MOVING)
        largest = (deviation / self.model.friction.nominal).log()
        for name in self.rigid.of_kind("sizes"):
            weights[name] = torch.where(bounded, weights[name].minimum(largest), weights[name])
        return self.rigid.flattened(weights)

    def squares(self, x: torch.Tensor) -> torch.Tensor:
        """Return sums of squares (n,) of the missing torque [Nm^2, N^2], as logged where gains are trained."""
        weights = self.rigid.named(x)
        total = torch.zeros(self.samples.joints).double()
        with torch.no_grad():
            for block in self._blocks:
                total += self._logged(weights, block).square().sum(dim=0)
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

    def normal_equations(self, x: torch.Tensor, noise: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return J^T J (K, K) and J^T r (K,) of the missing torque r, in units of ``noise`` (n,)."""
        curvature, descent = torch.zeros(len(x), len(x)).double(), torch.zeros(len(x)).double()
        for joint, columns, slope, missing in self._slopes(x):
            slope = slope / noise[joint]
            curvature[columns[:, None], columns] += slope.mT @ slope
            descent[columns] += slope.mT @ (missing / noise[joint])
        return curvature, descent

    def least_squares(
        self, x: torch.Tensor, noise: torch.Tensor, free: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return sums of squares (n,) that least squares by the free weights (K,) leave, and how many weights each
        torque determines (n,); torques are taken as linear about x (K,).
        """
        curvature, descent = self.normal_equations(x, noise)
        inverse = torch.zeros_like(curvature)
        inverse[free[:, None] & free] = _pseudo_inverse(curvature[free][:, free]).flatten()
        step = inverse @ descent
        squares, weights = torch.zeros(2, self.samples.joints).double()
        for joint, columns, slope, missing in self._slopes(x):
            squares[joint] += (missing - slope @ step[columns]).square().sum()
            weights[joint] += ((slope @ inverse[columns[:, None], columns]) * slope).sum() / noise[joint] ** 2
        return squares, weights

    def _slopes(self, x: torch.Tensor) -> Iterator[tuple[int, torch.Tensor, torch.Tensor, torch.Tensor]]:
        """Yield block by block each joint, the weights (C,) that move its torque, J (T, C) and what is missing (T,)."""
        weights, by_body = self.rigid.named(x), self._directions.of_weight < 0
        for block in self._blocks:
            missing, changes = self._joint_slope(weights, block)
            bodies = self._body_slope(weights, block)
            for joint in range(self.samples.joints):
                # of the weights of joints, few move this one's torque: the others' columns are zero
                own = self._directions.moves[:, joint]
                slope = torch.cat(
                    [bodies[:, joint], changes[self._directions.of_weight[own], :, joint].mT], 1
                )
                columns = torch.cat([by_body.nonzero()[:, 0], own.nonzero()[:, 0]])
                yield joint, columns, slope, missing[:, joint]

    def residual_samples(self, x: torch.Tensor) -> ResidualSamples:
        """Return what these weights leave of the torque, of all samples."""
        weights, blocks = self.rigid.named(x), []
        with torch.no_grad():
            for block in self._blocks:
                friction = block.factor * self._friction(weights, block, self._load(weights, block))
                missing = self._missing(weights, block)
                q, qd, qdd, _, _ = block.measured
                blocks.append(ResidualSamples(q, qd, qdd, missing, friction))
        return ResidualSamples(*(torch.cat(column) for column in zip(*blocks, strict=True)))

    def response(self, x: torch.Tensor, noise: torch.Tensor, covariance: torch.Tensor) -> RigidResponse:
        """Return how the weights follow, that have this covariance (K, K) after a fit under this noise (n,)."""
        blocks: list[list[torch.Tensor]] = [[] for _ in noise]
        gains = list(noise)
        for joint, columns, slope, _ in self._slopes(x):
            blocks[joint].append(slope)
            gains[joint] = covariance[columns[:, None], columns] / noise[joint] ** 2
        return RigidResponse(tuple(torch.cat(slopes) for slopes in blocks), tuple(gains))

    def torque_deviation(self) -> torch.Tensor:
        """Return standard deviations (n,) of the measured torque, as the joints feel it."""
        return self._joint_torque().std(dim=0)

    def _joint_torque(self) -> torch.Tensor:
        """Return the measured torque (T, n), as the joints feel it."""
        columns = self.samples.columns
        with torch.no_grad():
            torque: torch.Tensor = columns.tau @ self.model.input_matrix(columns.q[:1])[0].mT
        return torque

    def by_velocity(self, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return of the missing torque the slope by velocity (n,) [Nm s/rad, N s/m], how much of its sum of squares
        this line explains (n,), and how large that is, as a root mean square (n,) [Nm, N].
        """
        weights = self.rigid.named(x)
        sums = torch.zeros(3, self.samples.joints).double()
        with torch.no_grad():
            for block in self._blocks:
                tau, qd = self._missing(weights, block), block.measured.qd
                sums += torch.stack([tau * qd, qd * qd, tau * tau]).sum(dim=1)
        products, speeds, squares = sums
        slope = products / speeds.clamp(min=1e-300)
        size = (slope * products / self.samples.count).sqrt()
        return slope, slope * products / squares.clamp(min=1e-300), size

    def moved(self, x: torch.Tensor, step: torch.Tensor) -> torch.Tensor:
        """Return the weights (K,) after a step, which goes straight where torques do: in the bodies' inertial
        parameters, and in what grows of the quantities whose logarithms are weights.
        """
        change, bodies = self.rigid.named(step), self.rigid.bodies
        weights = self.rigid.named(x + step)
        for name in self.rigid.of_kind(*LOGARITHMS):
            weights[name] = (
                weights[name] - change[name] + torch.minimum(change[name], change[name].clamp(min=0).log1p())
            )
        moved = moved_bodies(self.rigid.named(x)[bodies], change[bodies])
        # bodies that stay keep their last digit, too
        weights[bodies] = torch.where(change[bodies].any(dim=-1, keepdim=True), moved, weights[bodies])
        return self.rigid.flattened(weights)

    def _with_regressors(self, block: Block) -> _Samples:
        q, qd, qdd, _, z = block
        rest = torch.zeros_like(q)
        model = self.model
        elements, columns = model.elements, z.shape[-1]
        with torch.no_grad():
            gravity_regressor = regressor_of(model.chain, q, rest, rest)
            return _Samples(
                measured=block,
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
        moves = self.model.motors != 0
        coupled = moves.double() @ moves.double().mT > 0
        colour = torch.tensor(_colours(coupled))
        colours = int(colour.max()) + 1
        by_name, of_weight, moved, count = {}, [], [], 0
        numbers = [
            weight[0].numel() for name, weight in self.rigid.start.items() if name != self.rigid.bodies
        ]
        total = colours * sum(numbers)
        for name, weight in self.rigid.start.items():
            if name == self.rigid.bodies:
                of_weight.append(torch.full((weight.numel(),), -1))
                moved.append(torch.zeros(weight.numel(), self.samples.joints, dtype=torch.bool))
                continue
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
        """Return the ten parameters of all bodies (B, 10)."""
        parameters: torch.Tensor = self._functional.under(weights, lambda model: model.inertial_parameters)
        return parameters

    def _load(self, weights: Weights, samples: _Samples) -> torch.Tensor:
        """Return the gravity torque that the drives bear (T, n)."""
        return samples.load_regressor @ self._inertial_parameters(weights).flatten()

    def _friction(self, weights: Weights, samples: _Samples, load: torch.Tensor) -> torch.Tensor:
        """Return friction's torque at the drives (T, n), as its laws alone have it."""
        constants = self._functional.under(weights, lambda model: model.friction.prepare())
        friction: torch.Tensor = self.model.friction(
            samples.speed, load, constants, samples.z, samples.direction
        )
        return friction

    def _missing(self, weights: Weights, samples: _Samples) -> torch.Tensor:
        """Return the torque that the model does not explain (T, n)."""
        _, qd, qdd, tau, _ = samples.measured

        def missing(model: Any) -> torch.Tensor:
            prepared, parameters = model.prepare(), model.inertial_parameters.flatten()
            load = samples.load_regressor @ parameters
            friction = model.friction(samples.speed, load, prepared.friction, samples.z, samples.direction)
            friction = samples.factor * friction
            force = model.input_force(None, qd, tau)
            inertial = samples.regressor @ parameters + qdd @ prepared.armature
            difference: torch.Tensor = force - inertial - samples.residual - friction @ model.motors
            return difference

        torque: torch.Tensor = self._functional.under(weights, missing)
        return torque

    def _logged(self, weights: Weights, samples: _Samples) -> torch.Tensor:
        """Return the missing torque in the units of what was logged (T, n)."""
        return self._missing(weights, samples) * self._per_gain(weights)

    def _joint_slope(self, weights: Weights, samples: _Samples) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the missing torque as logged (T, n), and minus its changes (D, T, n) along `_Directions`.

        J d is the derivative of J^T v, which is linear in v, by v. That takes reverse passes alone: forward ones go
        through constants too, as zeros whose shapes torch works out in Python, at several times the cost.
        """
        leaves = {name: weights[name].clone().requires_grad_() for name in self._directions.by_name}
        with torch.enable_grad():
            missing = self._logged({**weights, **leaves}, samples)
            v = torch.zeros_like(missing, requires_grad=True)
            products = gradient(missing, list(leaves.values()), v, create_graph=True, materialize_grads=True)
        directions = list(self._directions.by_name.values())
        (changes,) = gradient(products, v, directions, is_grads_batched=True, materialize_grads=True)
        return missing.detach(), -changes

    def _body_slope(self, weights: Weights, samples: _Samples) -> torch.Tensor:
        """Return minus the derivative (T, n, 10 B) by the bodies' weights: through the torque, and through the load
        that friction grows with.
        """
        load = self._load(weights, samples).detach().requires_grad_()
        with torch.enable_grad():
            friction = self._friction(weights, samples, load)
        (by_load,) = gradient(friction.sum(), load, materialize_grads=True)  # each drive's by its own load
        at_drives = (samples.factor * by_load).unsqueeze(-1) * samples.load_regressor
        loaded = samples.regressor + torch.einsum("mj,tmk->tjk", self.model.motors, at_drives)
        result: torch.Tensor = (loaded @ self._parameter_slope(weights)) * self._per_gain(weights)[:, None]
        return result.detach()

    def _parameter_slope(self, weights: Weights) -> torch.Tensor:
        """Return the derivative of the bodies' parameters by their weights (10 B, 10 B): each body's are its own."""
        bodies = weights[self.rigid.bodies].clone().requires_grad_()
        with torch.enable_grad():
            parameters = self._inertial_parameters({**weights, self.rigid.bodies: bodies})
        each = torch.eye(10).double().unsqueeze(1).expand(-1, len(bodies), -1)
        (slopes,) = gradient(parameters, bodies, each, is_grads_batched=True, materialize_grads=True)
        result: torch.Tensor = torch.block_diag(*slopes.transpose(0, 1))
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


def _pseudo_inverse(curvature: torch.Tensor) -> torch.Tensor:
    """Return the inverse (K, K) of a curvature in the directions that samples show."""
    length = curvature.diagonal().sqrt()
    scale = torch.where(length > 0, 1 / length, 0.0)
    scale = scale * scale[:, None]
    inverse: torch.Tensor = torch.linalg.pinv(curvature * scale, rtol=TUNING.seen, hermitian=True)
    return inverse * scale
