"""Name the parameters that logs of commanded positions determine, with their Gaussian prior, and a point among them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from itertools import chain
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch.autograd.functional import jacobian

from spelgen.dynamics.body_regressor import regressor_of
from spelgen.dynamics.parameters import parameters_of_kind
from spelgen.fitting.functional_model import evaluate_with
from spelgen.fitting.servo.tuning import ServoPriorTuning

if TYPE_CHECKING:
    from spelgen.emission.assemble import ArmModel

TUNING = ServoPriorTuning()
DEAD_ZONE = "servo.dead_zone"
COULOMB = "friction.raw_coulomb"
STRIBECK_VELOCITY = "friction.raw_stribeck_velocity"
FIXED = 1e-9  # deviation of a parameter that is not fitted


@dataclass(frozen=True, eq=False)
class ServoParameters:
    """Hold parameters of joints (p, n), along directions of the bodies (r,), and the delay [s].

    active: (p, n) whether a joint's parameter is fitted: dead zones only where a joint has one.
    """

    joints: torch.Tensor
    bodies: torch.Tensor
    delay: float
    active: torch.Tensor

    def moved(self, step: torch.Tensor) -> ServoParameters:
        """Return the parameters one step (k,) further; no command acts early."""
        joints, bodies, delay = step.split([self.joints.numel(), len(self.bodies), 1])
        return replace(
            self,
            joints=self.joints + joints.view_as(self.joints) * self.active,
            bodies=self.bodies + bodies,
            delay=max(0.0, self.delay + float(delay)),
        )

    @property
    def flat(self) -> torch.Tensor:
        """Return all in one vector, (k,) with k = p n + r + 1."""
        delay = torch.tensor([self.delay], dtype=torch.float64)
        return torch.cat([self.joints.flatten(), self.bodies, delay])


class ParameterRows:
    """Map the parameters of a model's joints to rows (p, n) and back.

    names: of the rows; a parameter of several numbers a joint has as many rows.
    """

    def __init__(self, model: ArmModel) -> None:
        self._n = model.n
        tensors = {**dict(model.named_parameters()), **dict(model.named_buffers())}
        # a drive's viscous friction and kd are one number: kd has it all
        rows = [
            *(parameters_of_kind(model, kind) for kind in ("stiffness", "damping", "armature", "offset")),
            (COULOMB, "friction.raw_stribeck", STRIBECK_VELOCITY),
            *(parameters_of_kind(model, kind) for kind in ("load_dependence", "fractions", "dead_zone")),
        ]
        self.tensors = {name: tensors[name] for name in chain(*rows)}
        self._widths = [x[:1].numel() for x in self.tensors.values()]
        self.names = np.repeat(list(self.tensors), self._widths).tolist()
        always = torch.from_numpy(np.array(self.names) != DEAD_ZONE)
        self.active = always.unsqueeze(-1).expand(-1, model.n)  # (p, n), at the start
        deviations = torch.full((len(self.names), 1), TUNING.logarithm).double()
        deviations[self.row(STRIBECK_VELOCITY)] = TUNING.stribeck_velocity
        deviations[self.row(DEAD_ZONE)] = TUNING.dead_zone
        self._deviations = deviations

    def row(self, name: str) -> int:
        """Return where the first row of a parameter is."""
        return self.names.index(name)

    def read(self) -> torch.Tensor:
        """Return what the model has, (p, n)."""
        columns = [x.detach().reshape(self._n, -1).mT for x in self.tensors.values()]
        return torch.cat(columns)

    def named(self, joints: torch.Tensor) -> dict[str, torch.Tensor]:
        """Return (P, p, n) as the model's tensors by name, each (P, 1, n) or (P, 1, n, K)."""
        parts = joints.unsqueeze(1).mT.split(self._widths, dim=-1)  # (P, 1, n, K)
        named = {}
        for (name, tensor), part in zip(self.tensors.items(), parts, strict=True):
            named[name] = part.reshape(*part.shape[:2], *tensor.shape)
        return named

    def write(self, x: ServoParameters) -> None:
        """Give the model the parameters of its joints."""
        with torch.no_grad():
            for name, rows in self.named(x.joints.unsqueeze(0)).items():
                self.tensors[name].copy_(rows[0, 0])

    def precision(self, x: ServoParameters) -> torch.Tensor:
        """Return the prior's, (k,)."""
        joints = torch.where(x.active, self._deviations, FIXED)
        others = torch.tensor([1.0] * len(x.bodies) + [TUNING.delay]).double()
        return torch.cat([joints.flatten(), others]) ** -2


def body_parameters(model: ArmModel) -> torch.nn.Parameter:
    """Return what the bodies' inertial parameters are made of, (B, 10)."""
    (name,) = parameters_of_kind(model, "bodies")
    return model.get_parameter(name)


def body_directions(model: ArmModel, q: torch.Tensor) -> torch.Tensor:
    """Return directions of the bodies' parameters that change gravity at q (M, n) most, (10 B, r), each as long as its
    standard deviation.
    """
    raw, zero = body_parameters(model).detach(), torch.zeros_like(q)
    # torch.func's jacobians import a compiler for more than a second
    slopes = jacobian(partial(inertial_parameters, model), raw)
    with torch.no_grad():
        gravity = regressor_of(model.chain, q, zero, zero) @ slopes.reshape(raw.numel(), -1)
    _, sizes, directions = torch.linalg.svd(gravity.flatten(0, 1), full_matrices=False)
    strong = sizes[: TUNING.body_directions] > 1e-3 * sizes[:1].clamp(min=1e-12)
    result: torch.Tensor = TUNING.bodies * directions[: len(strong)][strong].mT
    return result


def inertial_parameters(model: ArmModel, raw: torch.Tensor) -> torch.Tensor:
    """Return the ten parameters of all bodies, (B, 10), made of trained ones (B, 10)."""
    (name,) = parameters_of_kind(model, "bodies")
    parameters: torch.Tensor = evaluate_with(model, {name: raw}, lambda x: x.inertial_parameters)
    return parameters
