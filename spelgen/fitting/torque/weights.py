"""The weights of bodies, drives and friction laws, which a fit to torques moves."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from spelgen.dynamics.parameters import parameter_table
from spelgen.dynamics.protocol import motors_of
from spelgen.fitting.functional_model import Weights
from spelgen.fitting.torque.samples import Block
from spelgen.fitting.torque.tuning import TorqueTuning
from spelgen.logs.tuning import SAMPLES
from spelgen.runtime.rigid_body import body_factor
from spelgen.settings.fits import Adaptation

if TYPE_CHECKING:
    from spelgen.emission.assemble import ArmModel

RIGID = (
    "bodies", "friction_compensation", "gains", "armature", "offset", "sizes", "effects", "velocities",
    "load_dependence", "fractions",
)  # fmt: skip
"""Kinds of parameters of bodies, drives and friction laws: all but what stands beside them."""
TUNING = TorqueTuning()
MOVING = SAMPLES.moving
DAILY = ("sizes", "effects", "velocities", "load_dependence", "fractions", "offset")
"""Kinds that change from day to day."""
NONE = -30.0  # of a size that is none, the logarithm


class RigidWeights:
    """The weights of bodies, drives and friction laws of a model, by name, and what they stand for."""

    def __init__(self, model: ArmModel) -> None:
        tensors = {**dict(model.named_parameters()), **dict(model.named_buffers())}
        self.kinds: dict[str, str] = {}
        self.tensors: dict[str, torch.Tensor] = {}  # parameters, and buffers that a fit may set
        self.start: dict[str, torch.Tensor] = {}
        for name, info in parameter_table(model).items():
            if info.kind in RIGID:
                self.kinds[name], self.tensors[name] = info.kind, tensors[name]
                self.start[name] = tensors[name].detach().clone()
        (self.bodies,) = self.of_kind("bodies")
        (self.compensation,) = self.of_kind("friction_compensation")
        self.sizes = [weight.numel() for weight in self.start.values()]

    def of_kind(self, *kinds: str) -> list[str]:
        """Return the names of weights of these kinds."""
        return [name for name, kind in self.kinds.items() if kind in kinds]

    def named(self, x: torch.Tensor) -> dict[str, torch.Tensor]:
        """Return the weights by name, of all of them flattened one after the other (K,)."""
        pieces = zip(self.start.items(), x.split(self.sizes), strict=True)
        return {name: piece.view_as(weight) for (name, weight), piece in pieces}

    def write(self, x: torch.Tensor) -> None:
        """Put weights (K,) into the model."""
        with torch.no_grad():
            for name, weight in self.named(x).items():
                self.tensors[name].copy_(weight)

    def flattened(self, weights: Weights) -> torch.Tensor:
        """Return weights by name as one vector (K,)."""
        return torch.cat([weights[name].flatten() for name in self.start])

    def mask(self, *kinds: str) -> torch.Tensor:
        """Return which weights (K,) are of these kinds."""
        named = self.start.items()
        return self.flattened({name: torch.full_like(x, self.kinds[name] in kinds) for name, x in named}) > 0

    def free(self, adapt: Adaptation | None, compensated: torch.Tensor) -> torch.Tensor:
        """Return which weights (K,) move: all, or those of an adaptation; compensation of the joints (n,) that have
        one.
        """
        if adapt == "load":
            free = self.mask()
            self.named(free)[self.bodies][-1] = True
            return free
        free = self.mask(*(DAILY if adapt == "friction" else RIGID))
        self.named(free)[self.compensation].copy_(compensated)
        return free


def joint_torque(model: ArmModel, samples: Block) -> torch.Tensor:
    """Return the measured torque (T, n), as the joints feel it."""
    with torch.no_grad():
        torque: torch.Tensor = samples.tau @ model.input_matrix(samples.q[:1])[0].mT
    return torque


def bound_friction(model: ArmModel, samples: Block) -> None:
    """Let no usual friction of the model be larger than the deviation of its drive's torque.

    It is guessed from efforts, which many URDFs have as placeholders: offsets in its units would pass for weights.
    """
    rigid, motors = RigidWeights(model), motors_of(model)
    with torch.no_grad():
        of_drives = joint_torque(model, samples) @ torch.linalg.inv(motors)
        largest = of_drives.std(dim=0) / model.friction.nominal
        # a drive that stands still, or gives no torque, shows no friction
        shown = (largest > 0) & ((samples.qd @ motors.mT).abs().amax(dim=0) > MOVING)
        largest = torch.where(shown, largest, torch.inf)
        change = largest.clamp(max=1.0)
        model.friction.nominal *= change
    weights = dict(rigid.start)
    for name in rigid.of_kind("sizes", "effects"):
        weights[name] = weights[name].minimum(largest.log()) - change.log()
    for name in rigid.of_kind("offset", "friction_compensation"):
        weights[name] = weights[name] / change
    rigid.write(rigid.flattened(weights))


def moved_bodies(raw: torch.Tensor, step: torch.Tensor) -> torch.Tensor:
    """Return weights (B, 10) after a step (B, 10), as `InertialParameters` has them, straight where torques go.

    Torques are linear in the inertial parameters, for which weights stand by way of a Cholesky factor: a step straight
    in the weights leaves the line that a Gauss-Newton step was computed along.
    A body's pseudo-inertia is C S C^T, S = T T^T. To first order the step adds T (X + X^T) T^T to S, and that is what
    is added, or as much of it as keeps S positive definite.
    """
    row, column = torch.triu_indices(4, 4)
    weights, moves = torch.zeros(2, len(raw), 4, 4).double()
    weights[:, row, column], moves[:, row, column] = raw, step
    # a complex step differentiates to the last digit; forward mode would load torch's compiler, which takes seconds
    tiny = 1e-100
    stepped = body_factor(torch.complex(weights, tiny * moves))
    factor, change = stepped.real, stepped.imag / tiny
    relative = torch.linalg.solve_triangular(factor, change, upper=True)
    added = relative + relative.mT
    smallest = torch.linalg.eigvalsh(added)[:, 0]
    fraction = (TUNING.body_step / (-smallest).clamp(min=1e-12)).clamp(max=1.0)
    factor = factor @ upper_cholesky(torch.eye(4).double() + fraction[:, None, None] * added)
    return body_weights(factor)


def upper_cholesky(matrix: torch.Tensor) -> torch.Tensor:
    """Return the upper triangular U, (..., n, n), with U U^T the matrix."""
    lower: torch.Tensor = torch.linalg.cholesky(matrix.flip(-1, -2))
    return lower.flip(-1, -2)


def body_weights(factor: torch.Tensor) -> torch.Tensor:
    """Return the weights (B, 10) of which `body_factor` makes this factor (B, 4, 4)."""
    scale = factor.diagonal(dim1=-2, dim2=-1)
    sizes, mass = scale[:, :3].log(), scale[:, 3:].log()
    logarithms = torch.cat([sizes - mass, 2 * mass], dim=-1)
    weights = (factor / scale.unsqueeze(-1)).triu(1) + logarithms.diag_embed()
    row, column = torch.triu_indices(4, 4)
    return weights[:, row, column]
