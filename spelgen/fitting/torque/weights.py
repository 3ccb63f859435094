"""The weights of bodies, drives and friction laws, which a fit to torques moves."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from spelgen.dynamics.parameters import parameter_table
from spelgen.dynamics.protocol import motors_of
from spelgen.fitting.functional_model import Weights
from spelgen.fitting.torque.samples import Block
from spelgen.settings.fits import Adaptation
from spelgen.settings.tuning.identification import IdentificationTuning

if TYPE_CHECKING:
    from spelgen.emission.loading import EmittedModel

RIGID = (
    "bodies", "friction_compensation", "gains", "armature", "offset", "sizes", "effects", "velocities",
    "load_dependence", "fractions",
)  # fmt: skip
"""Kinds of parameters of bodies, drives and friction laws: all but what stands beside them."""
MOVING = IdentificationTuning().moving
DAILY = ("sizes", "effects", "velocities", "load_dependence", "fractions", "offset")
"""Kinds that change from day to day."""
NONE = -30.0  # of a size that is none, the logarithm


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

    def flattened(self, weights: Weights) -> torch.Tensor:
        """Return weights by name as one vector (K,)."""
        return torch.cat([weights[name].flatten() for name in self.start])

    def free(self, adapt: Adaptation | None, compensated: torch.Tensor) -> torch.Tensor:
        """Return which weights (K,) move: all, or those of an adaptation; compensation of the joints (n,) that have
        one.
        """
        kinds = {"load": (), "friction": DAILY}.get(adapt or "", RIGID)
        masks = {}
        for name, weight in self.start.items():
            masks[name] = torch.full_like(weight, self.kinds[name] in kinds, dtype=torch.bool)
        if adapt == "load":
            masks[self.bodies][-1] = True
        else:
            masks[self.compensation] = compensated
        return self.flattened(masks)


def joint_torque(model: EmittedModel, samples: Block) -> torch.Tensor:
    """Return the measured torque (T, n), as the joints feel it."""
    with torch.no_grad():
        torque: torch.Tensor = samples.tau @ model.input_matrix(samples.q[:1])[0].mT
    return torque


def bound_friction(model: EmittedModel, samples: Block) -> None:
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
