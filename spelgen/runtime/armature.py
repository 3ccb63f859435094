"""What the rotors of the drives add to the mass matrix."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from spelgen.runtime.joints import Joints, vector


class Armature(nn.Module):
    """Rotor inertia times gear squared of each joint, never negative; the weights are logarithms."""

    kinds = (("raw", "armature", "kg m^2, kg"),)

    def __init__(self, joints: Joints) -> None:
        super().__init__()
        self.nominal = nn.Buffer(vector(joints.armature))
        self.raw = nn.Parameter(torch.zeros(joints.n, dtype=torch.float64))

    def forward(self) -> Tensor:
        """Return the diagonal of the drives' part of M, (n,) [kg m^2, kg]."""
        return self.nominal * self.raw.exp()
