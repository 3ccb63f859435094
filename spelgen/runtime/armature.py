"""What the rotors of the drives add to the mass matrix."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from spelgen.runtime.joints import Joints, vector


class Armature(nn.Module):
    """Rotor inertia times gear squared of each joint, never negative; the weights are logarithms."""

    kinds = (("raw", "armature", "kg m^2, kg"),)

    nominal: Tensor
    gear: Tensor

    def __init__(self, joints: Joints) -> None:
        super().__init__()
        self.register_buffer("nominal", vector(joints.armature))
        self.register_buffer("gear", vector(joints.gear))
        self.raw = nn.Parameter(torch.zeros(joints.n, dtype=torch.float64))

    def forward(self) -> Tensor:
        """The diagonal of the drives' part of M, (n,) [kg m^2, kg]."""
        return self.nominal * self.raw.exp()

    def rotor_inertia(self) -> Tensor:
        """As the motors feel it, before the gear, (n,) [kg m^2, kg]."""
        return self.nominal * self.raw.exp() / self.gear**2
