"""The torque that rigid bodies miss on samples, and its normal equations by all weights, block by block."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch.autograd import grad as gradient

from spelgen.dynamics.body_regressor import regressor_of
from spelgen.dynamics.protocol import motors_of
from spelgen.dynamics.residuals import friction_factor, residual_torque
from spelgen.fitting.functional_model import Weights, under_weights
from spelgen.fitting.torque.samples import Block, TorqueSamples
from spelgen.fitting.torque.tuning import TorqueTuning
from spelgen.fitting.torque.weights import RigidWeights, joint_torque, moved_bodies

if TYPE_CHECKING:
    from spelgen.emission.assemble import ArmModel

TUNING = TorqueTuning()
NO_FUNCTIONS: Mapping[int, FollowingFunctions] = {}
LOGARITHMS = ("armature", "sizes", "effects", "load_dependence")


class _Samples(NamedTuple):
    """Samples (T, n) with the drives' motion, and the regressors (T, n, 10 B) of torque and of the gravity torque that
    the drives bear. residual: (T, n) torque of what stands beside rigid bodies. factor: (T, n) on friction.
    """

    measured: Block
    speed: torch.Tensor
    acceleration: torch.Tensor
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


class Slope(NamedTuple):
    """How a joint's torque follows the columns (C,) of weights that move it: J (T, C); and what is missing (T,)."""

    joint: int
    columns: torch.Tensor
    slope: torch.Tensor
    missing: torch.Tensor


@dataclass(frozen=True, eq=False)
class FollowingFunctions:
    """Functions of a joint's position, of which weights follow whatever else explains its torque: variable projection
    (Golub and Pereyra, SIAM J. Numer. Anal. 10:413, 1973).

    features: (T, P). penalty: (P,) of a weight's square, in squares of the torque.
    """

    features: torch.Tensor
    penalty: torch.Tensor

    @cached_property
    def gains(self) -> torch.Tensor:
        """Return the weights by the torque of each sample (P, T)."""
        curvature = self.features.mT @ self.features + self.penalty.diag()
        gains: torch.Tensor = torch.linalg.solve(curvature, self.features.mT)
        return gains

    def weights(self, torque: torch.Tensor) -> torch.Tensor:
        """Return the weights (P, ...) that explain most of a torque (T, ...) at the least penalty."""
        return self.gains @ torque

    def left(self, torque: torch.Tensor) -> torch.Tensor:
        """Return (T + P, ...) what they leave of a torque (T, ...), then roots of the penalties."""
        weights = self.weights(torque)
        return torch.cat([torque - self.features @ weights, self.penalty.sqrt().diag() @ weights])


class RigidResponse(NamedTuple):
    """How bodies, drives and friction laws follow a torque on each joint.

    slopes: J (T, C), see `TorqueJacobian.slopes`. gains: what a fit of these makes of J^T torque (C, C).
    """

    slopes: tuple[torch.Tensor, ...]
    gains: tuple[torch.Tensor, ...]

    def remaining(self, joint: int, torque: torch.Tensor) -> torch.Tensor:
        """Return what of torques (T, P) on a joint is left when these weights have taken over what they can."""
        slope = self.slopes[joint]
        return torque - slope @ (self.gains[joint] @ (slope.mT @ torque))


class TorqueJacobian:
    """Of a model of rigid bodies on ``samples``; x is all their weights (K,), flattened one after the other.

    Residuals beside bodies are taken as they are when this is made, but for functions of joints that follow.
    """

    def __init__(
        self,
        model: ArmModel,
        samples: TorqueSamples,
        functions: Mapping[int, FollowingFunctions] = NO_FUNCTIONS,
    ) -> None:
        self.model: Any = model
        self.functions = functions
        self.samples = samples
        self.rigid = RigidWeights(model)
        self._of_bodies = self.rigid.mask("bodies")
        self._motors = motors_of(model)
        self._drives = self._motors != 0  # (n, n): whether a drive moves a joint
        self._moves = self._moved_joints()
        self._colours = _colours(self._drives.double().mT @ self._drives.double() > 0)
        self._blocks = [self._with_regressors(block) for block in samples.blocks(TUNING.block)]

    def squares(self, x: torch.Tensor) -> torch.Tensor:
        """Return sums of squares (n,) of the missing torque [Nm^2, N^2], as logged where gains are trained."""
        weights = self.rigid.named(x)
        with torch.no_grad():
            blocks = [self._missing(weights, block)[0] for block in self._blocks]
        missing = torch.cat(blocks) * self.per_gain(x)
        squares = missing.square().sum(dim=0)
        for joint, functions in self.functions.items():
            squares[joint] = functions.left(missing[:, joint]).square().sum()
        return squares

    def per_gain(self, x: torch.Tensor) -> torch.Tensor:
        """Return what of a joint torque is logged (n,), relative to the start: 1, but where gains are trained."""
        return self._per_gain(self.rigid.named(x)).detach()

    def _per_gain(self, weights: Weights) -> torch.Tensor:
        ones = torch.ones(self.model.n).double()
        for name in self.rigid.of_kind("gains"):  # logarithms of gains between logged and joint torques
            change = weights[name] - self.rigid.start[name]
            return ones.expand(*change.shape[:-1], -1).index_copy(-1, self.model.gain_rows, (-change).exp())
        return ones

    def normal_equations(self, x: torch.Tensor, noise: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return J^T J (K, K) and J^T r (K,) of the missing torque r, in units of ``noise`` (n,)."""
        slopes: Iterable[Slope] = self.slopes(x)
        if self.functions:
            slopes = self._left_by_functions(slopes)
        curvature, descent = _normal_equations(slopes, noise, len(x))
        along = self._along(x)
        return along.mT @ curvature @ along, along.mT @ descent

    def least_squares(
        self, slopes: Sequence[Slope], noise: torch.Tensor, free: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return sums of squares (n,) that least squares by the free weights (K,) leave, and how many weights each
        torque determines (n,); torques are linear, with these `slopes`.
        """
        curvature, descent = _normal_equations(slopes, noise, len(free))
        inverse = torch.zeros_like(curvature)
        inverse[free[:, None] & free] = _pseudo_inverse(curvature[free][:, free]).flatten()
        step = inverse @ descent
        squares, weights = torch.zeros(2, len(noise)).double()
        for joint, columns, slope, missing in slopes:
            squares[joint] += (missing - slope @ step[columns]).square().sum()
            weights[joint] += ((slope @ inverse[columns[:, None], columns]) * slope).sum() / noise[joint] ** 2
        return squares, weights

    def slopes(self, x: torch.Tensor) -> Iterator[Slope]:
        """Yield J of each joint, block by block: by the bodies' parameters in place of their weights, see `_along`."""
        weights, per_gain = self.rigid.named(x), self.per_gain(x)
        of_bodies, of_joints = self._of_bodies.nonzero()[:, 0], (~self._of_bodies).nonzero()[:, 0]
        for block in self._blocks:
            missing, by_weights, by_load = self._joint_slope(weights, block)
            for joint, colour in enumerate(self._colours):
                # of the weights of joints, few move this one's torque: the others' columns are zero
                moving, drives = self._moves[:, joint], self._drives[:, joint]
                loads = by_load[colour][:, drives].unsqueeze(-1) * block.load_regressor[:, drives]
                bodies = per_gain[joint] * block.regressor[:, joint] + loads.sum(dim=1)
                slope = torch.cat([bodies, by_weights[colour][:, moving]], dim=1)
                yield Slope(joint, torch.cat([of_bodies, of_joints[moving]]), slope, missing[:, joint])

    def _left_by_functions(self, slopes: Iterable[Slope]) -> Iterator[Slope]:
        """Yield of each joint what its functions leave, of all samples."""
        for slope in _by_joint(slopes, self.model.n):
            functions = self.functions.get(slope.joint)
            if functions is None:
                yield slope
            else:
                yield slope._replace(slope=functions.left(slope.slope), missing=functions.left(slope.missing))

    def _along(self, x: torch.Tensor) -> torch.Tensor:
        """Return the derivative (K, K) of what torques are linear in by the weights: each body's are its own."""
        weights = self.rigid.named(x)
        # ten times the weights: one for the derivative of each parameter
        bodies = weights[self.rigid.bodies].expand(10, -1, -1).detach().requires_grad_()
        with torch.enable_grad():
            parameters = self._inertial_parameters({**weights, self.rigid.bodies: bodies})
        (slopes,) = gradient(parameters.diagonal(dim1=0, dim2=2).sum(), bodies)
        along = torch.eye(len(x)).double()
        along[self._of_bodies[:, None] & self._of_bodies] = torch.block_diag(
            *slopes.transpose(0, 1)
        ).flatten()
        return along

    def residual_samples(self, x: torch.Tensor) -> ResidualSamples:
        """Return what these weights leave of the torque, of all samples."""
        weights, blocks = self.rigid.named(x), []
        with torch.no_grad():
            for block in self._blocks:
                motion = block.measured[:3]
                blocks.append(ResidualSamples(*motion, *self._missing(weights, block)))
        return ResidualSamples(*(torch.cat(column) for column in zip(*blocks, strict=True)))

    def response(self, x: torch.Tensor, noise: torch.Tensor, covariance: torch.Tensor) -> RigidResponse:
        """Return how the weights follow, that have this covariance (K, K) after a fit under this noise (n,)."""
        along = self._along(x)
        covariance = along @ covariance @ along.mT
        slopes = _by_joint(self.slopes(x), len(noise))
        gains = []
        for joint, columns, _, _ in slopes:
            gains.append(covariance[columns[:, None], columns] / noise[joint] ** 2)
        return RigidResponse(tuple(of_joint.slope for of_joint in slopes), tuple(gains))

    def torque_deviation(self) -> torch.Tensor:
        """Return standard deviations (n,) of the measured torque, as the joints feel it."""
        return joint_torque(self.model, self.samples.columns).std(dim=0)

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
        model, q, qd, qdd = self.model, block.q, block.qd, block.qdd
        still = torch.zeros_like(q)
        with torch.no_grad():
            gravity_regressor = regressor_of(model.chain, q, still, still)
            return _Samples(
                measured=block,
                speed=qd @ self._motors.mT,
                acceleration=qdd @ self._motors.mT,
                regressor=regressor_of(model.chain, q, qd, qdd),
                load_regressor=torch.einsum("jm,tjk->tmk", torch.linalg.inv(self._motors), gravity_regressor),
                residual=residual_torque(model, q, qd, qdd),
                factor=friction_factor(model, q),
            )

    def _moved_joints(self) -> torch.Tensor:
        """Return which joints' torques each weight moves (K', n), of all weights but those of bodies."""
        moves = []
        for name, weight in self.rigid.start.items():
            if name == self.rigid.bodies:
                continue
            rows = self._drives
            if self.rigid.kinds[name] == "gains":
                rows = rows[self.model.gain_rows]
            moves.append(rows.repeat_interleave(weight[0].numel(), dim=0))
        return torch.cat(moves)

    def _inertial_parameters(self, weights: Weights) -> torch.Tensor:
        """Return the ten parameters of all bodies (B, 10)."""
        parameters: torch.Tensor = under_weights(self.model, weights, lambda model: model.inertial_parameters)
        return parameters

    def _missing(
        self, weights: Weights, samples: _Samples, load: torch.Tensor | None = None
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the torque that the model does not explain, and that of friction at the drives, (T, n).

        load: gravity torque that the drives bear (T, n); None: that of the weights.
        """
        measured = samples.measured

        def torques(model: Any) -> tuple[torch.Tensor, torch.Tensor]:
            constants, parameters = model.friction.prepare(), model.inertial_parameters.flatten()
            borne = samples.load_regressor @ parameters if load is None else load
            friction = constants.torque(samples.speed, borne, measured.z, measured.direction)
            friction = samples.factor * friction
            of_drives = friction + model.armature * samples.acceleration
            force = model.input_force(None, measured.qd, measured.tau) - samples.residual
            return force - samples.regressor @ parameters - of_drives @ self._motors, friction

        missing, friction = under_weights(self.model, weights, torques)
        return missing, friction

    def _joint_slope(
        self, weights: Weights, samples: _Samples
    ) -> tuple[torch.Tensor, list[torch.Tensor], list[torch.Tensor]]:
        """Return the missing torque as logged (T, n), and minus its derivatives, for each colour of joints the sum of
        theirs: (T, K) by the K weights that are not of bodies, and (T, n) by the load on each drive.

        With weights of their own all samples have their slopes in one reverse pass: a weight moves a joint of a colour.
        The gradients are those of sums: of several outputs they would load torch's symbolic shapes, half a second.
        """
        repeated = {}
        for name, weight in weights.items():
            if name != self.rigid.bodies:
                repeated[name] = weight.expand(len(samples.speed), *weight.shape).detach().requires_grad_()
        parameters = self._inertial_parameters(weights).flatten()
        load = (samples.load_regressor @ parameters).detach().requires_grad_()
        with torch.enable_grad():
            by_sample = {**weights, **repeated}
            missing = self._missing(by_sample, samples, load)[0] * self._per_gain(by_sample)
        by_weights, by_load, colours = [], [], torch.tensor(self._colours)
        for colour in range(max(self._colours) + 1):
            total = -missing[:, colours == colour].sum()
            slopes = gradient(total, [load, *repeated.values()], retain_graph=True, materialize_grads=True)
            by_load.append(slopes[0])
            by_weights.append(torch.cat([slope.flatten(1) for slope in slopes[1:]], dim=1))
        return missing.detach(), by_weights, by_load


def _by_joint(slopes: Iterable[Slope], joints: int) -> list[Slope]:
    """Return the slope of each joint, of the samples of all blocks."""
    blocks: list[list[Slope]] = [[] for _ in range(joints)]
    for slope in slopes:
        blocks[slope.joint].append(slope)
    return [
        of_joint[0]._replace(
            slope=torch.cat([block.slope for block in of_joint]),
            missing=torch.cat([block.missing for block in of_joint]),
        )
        for of_joint in blocks
    ]


def _normal_equations(
    slopes: Iterable[Slope], noise: torch.Tensor, count: int
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return J^T J (K, K) and J^T r (K,) of so many weights, in units of noise (n,)."""
    curvature, descent = torch.zeros(count, count).double(), torch.zeros(count).double()
    for joint, columns, slope, missing in slopes:
        curvature[columns[:, None], columns] += slope.mT @ slope / noise[joint] ** 2
        descent[columns] += slope.mT @ missing / noise[joint] ** 2
    return curvature, descent


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
