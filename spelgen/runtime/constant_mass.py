"""M of an arm whose mass matrix does not depend on q."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from spelgen.runtime.parts import Entries
from spelgen.runtime.rows import Constant, Joint, vector


class ConstantMass(nn.Module):
    """M, (..., n, n): ``entries(*constants)`` and the armature.

    The absolute values of the constants are used, so that M stays positive definite.
    """

    parameter_groups = (
        ("raw_constants", "mass_constants", "kg m^2, kg m, kg"),
        ("raw_armature", "armature", "kg m^2, kg"),
    )

    def __init__(self, joints: Sequence[Joint], entries: Entries, *, constants: Sequence[Constant]) -> None:
        super().__init__()
        self.entries = entries
        self.constant_scale = nn.Buffer(vector(x.scale for x in constants))
        self.raw_constants = nn.Parameter(vector(x.initial / x.scale for x in constants))
        self.nominal_armature = nn.Buffer(vector(joint.armature for joint in joints))
        self.raw_armature = nn.Parameter(torch.zeros_like(self.nominal_armature))  # logarithm

    def armature(self) -> Tensor:
        """Return the rotor inertia on the joint side, part of the diagonal of M, (n,) [kg m^2, kg]."""
        return self.nominal_armature * self.raw_armature.exp()

    def constants(self) -> Tensor:
        """Return the constants of M, (constants,) [kg m^2, kg m, kg]."""
        return self.constant_scale * (self.raw_constants.abs() + 1e-6)

    def prepare(self) -> Tensor:
        """Return M, (n, n)."""
        return self.entries(*self.constants().unbind()) + torch.diag(self.armature())

    def forward(self, encoded: Tensor, parameters: Tensor) -> tuple[Tensor, Tensor]:
        """Return M, (..., n, n), and the encoding, (..., 2 n), which has the shape of its derivatives."""
        return parameters.expand(*encoded.shape[:-1], *parameters.shape), encoded

    def kinetic_vjp(self, qd: Tensor, intermediates: Tensor) -> Tensor:
        """Return d(1/2 qd^T M qd) / d encoding, (..., 2 n): zero."""
        return torch.zeros_like(intermediates)

    def jvp(self, rate: Tensor, intermediates: Tensor) -> Tensor:
        """Return dM/dt, (..., n, n): zero."""
        n = len(self.raw_armature)
        return rate.new_zeros(*rate.shape[:-1], n, n)
