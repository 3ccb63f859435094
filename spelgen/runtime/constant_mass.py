"""M of an arm whose mass matrix does not depend on q."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from spelgen.runtime.armature import Armature
from spelgen.runtime.joints import Joints, Pairs, vector
from spelgen.runtime.symmetric import Entries


class ConstantMass(nn.Module):
    """M, (..., n, n), with ``entries`` saying where the constants stand.

    A constant starts at the first of its two numbers, and is trained in units of the second. They
    enter by their sizes, so that M stays positive definite.
    """

    kinds = (("raw_constants", "mass_constants", "kg m^2, kg m, kg"),)

    def __init__(self, joints: Joints, entries: Entries, constants: Pairs) -> None:
        super().__init__()
        self.n, self.entries = joints.n, entries
        self.constant_scale = nn.Buffer(vector(unit for _, unit in constants))
        self.raw_constants = nn.Parameter(vector(start / unit for start, unit in constants))
        self.rotors = Armature(joints)

    def constants(self) -> Tensor:
        """The constants of M, (constants,), in their units."""
        return self.constant_scale * (self.raw_constants.abs() + 1e-6)

    def prepare(self, definite: bool = True) -> Tensor:
        """M, (n, n)."""
        return self.entries((), self.constants().unbind()) + torch.diag(self.rotors.forward())

    def forward(self, encoded: Tensor, prepared: Tensor) -> tuple[Tensor, None]:
        """M, for each state."""
        return prepared.expand(*encoded.shape[:-1], self.n, self.n), None

    def kinetic_vjp(self, encoded: Tensor, qd: Tensor, residuals: object) -> Tensor:
        """The derivative of 1/2 qd^T M qd by the encoding: zero."""
        return torch.zeros_like(encoded)

    def jvp(self, rate: Tensor, residuals: object) -> Tensor:
        """dM/dt, (..., n, n): zero."""
        return rate.new_zeros(*rate.shape[:-1], self.n, self.n)
