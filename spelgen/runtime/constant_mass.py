"""M of an arm whose mass matrix does not depend on q."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from spelgen.runtime.joints import Joints, vector
from spelgen.runtime.parts import Layout, Pairs


class ConstantMass(nn.Module):
    """M, (..., n, n), with ``entries`` saying where the constants stand.

    A constant starts at the first of its two numbers, and is trained in units of the second. They
    enter by their sizes, so that M stays positive definite.
    """

    kinds = (
        ("raw_constants", "mass_constants", "kg m^2, kg m, kg"),
        ("raw_armature", "armature", "kg m^2, kg"),
    )

    def __init__(self, joints: Joints, entries: Layout, constants: Pairs) -> None:
        super().__init__()
        self.entries = entries
        self.constant_scale = nn.Buffer(vector(unit for _, unit in constants))
        self.raw_constants = nn.Parameter(vector(start / unit for start, unit in constants))
        self.nominal_armature = nn.Buffer(vector(joints.armature))
        self.raw_armature = nn.Parameter(torch.zeros_like(self.nominal_armature))  # its logarithm

    def armature(self) -> Tensor:
        """Return the drives' part of M's diagonal, (n,) [kg m^2, kg]."""
        return self.nominal_armature * self.raw_armature.exp()

    def constants(self) -> Tensor:
        """Return the constants of M, (constants,), in their units."""
        return self.constant_scale * (self.raw_constants.abs() + 1e-6)

    def prepare(self) -> Tensor:
        """Return M, (n, n)."""
        return self.entries((), self.constants().unbind()) + torch.diag(self.armature())

    def forward(self, encoded: Tensor, prepared: Tensor) -> tuple[Tensor, Tensor]:
        """Return M for each state, and the encoding, which has the shape of its derivatives."""
        return prepared.expand(*encoded.shape[:-1], *prepared.shape), encoded

    def kinetic_vjp(self, qd: Tensor, intermediates: Tensor) -> Tensor:
        """Return the derivative of 1/2 qd^T M qd by the encoding: zero."""
        return torch.zeros_like(intermediates)

    def jvp(self, rate: Tensor, intermediates: Tensor) -> Tensor:
        """Return dM/dt, (..., n, n): zero."""
        n = len(self.raw_armature)
        return rate.new_zeros(*rate.shape[:-1], n, n)
