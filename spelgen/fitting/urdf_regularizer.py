"""Regularizer towards the mass matrix and gravity torque of a URDF, for directions that the logs do not determine.

The variation of M with q is compared, not its mean: rotors and loads that the URDF does not specify add constants.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import torch

from spelgen.dynamics.pinocchio_dynamics import urdf_dynamics
from spelgen.emission.assemble import ArmModel
from spelgen.fitting.tuning import TUNING
from spelgen.logs.windows import Windows


class UrdfRegularizer(NamedTuple):
    """Variation of M and gravity torque of a URDF at S positions.

    q: (S, n) [rad, m]. whitening: (n, n), inverse Cholesky factor of the model's mean M before the fit. variation:
    (S, n, n) of M, whitened. gravity: (S, n) [Nm, N]. gravity_scale: (n,) [Nm, N], unit of its errors.
    """

    q: torch.Tensor
    whitening: torch.Tensor
    variation: torch.Tensor
    gravity: torch.Tensor
    gravity_scale: torch.Tensor

    def loss(self, model: ArmModel) -> torch.Tensor:
        """Return the mean squared difference of the model in M and in the gravity torque, (), both without unit."""
        variation = _variation(model.mass_matrix(self.q), self.whitening) - self.variation
        gravity = (model.gravity(self.q) - self.gravity) / self.gravity_scale
        return variation.square().sum(dim=(-2, -1)).mean() / gravity.shape[-1] + gravity.square().mean()

    def to(self, device: str | torch.device) -> UrdfRegularizer:
        """Return the regularizer on another device."""
        return UrdfRegularizer(*(x.to(device) for x in self))


def urdf_regularizer(urdf: Path, joints: Sequence[str], model: ArmModel, windows: Windows) -> UrdfRegularizer:
    """Return the regularizer of a URDF at random positions in the range of a log.

    Args:
        urdf: file.
        joints: names of the model's n joints.
        model: its mean M before the fit is the unit of M.
        windows: positions (W, K, n) [rad, m], whose range is widened.

    Raises:
        ImportError: without Pinocchio, whose own errors are raised too.
    """
    dynamics = urdf_dynamics(urdf, joints)
    positions = windows.q.flatten(0, 1)
    low, high = positions.amin(dim=0), positions.amax(dim=0)
    low, high = (
        low - TUNING.regularizer_margin * (high - low),
        high + TUNING.regularizer_margin * (high - low),
    )
    generator = torch.Generator().manual_seed(0)
    q = low + (high - low) * torch.rand(
        TUNING.regularizer_points, len(joints), dtype=positions.dtype, generator=generator
    )
    with torch.no_grad():
        whitening = torch.linalg.inv(torch.linalg.cholesky(model.mass_matrix(q).mean(dim=0)))
    gravity = dynamics.gravity(q)
    scale = gravity.square().mean(dim=0).sqrt()
    largest = scale.max().item()
    floor = TUNING.min_gravity_scale * largest
    if not largest:
        floor = 1.0  # no gravity torque at any joint: the unit is arbitrary
    scale = scale.clamp(min=floor)
    return UrdfRegularizer(q, whitening, _variation(dynamics.mass_matrix(q), whitening), gravity, scale)


def _variation(mass: torch.Tensor, whitening: torch.Tensor) -> torch.Tensor:
    """Return W (M - mean M) W^T, (S, n, n), of M (S, n, n) and the whitening W (n, n)."""
    return whitening @ (mass - mass.mean(dim=0)) @ whitening.mT
