"""A regularizer towards the URDF's own M and gravity, for where the logs say little.

How M varies with q is compared, not its mean: rotors and loads that the URDF leaves out add constants.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import torch

from spelgen.dynamics.pinocchio_urdf import urdf_dynamics
from spelgen.logs.windows import Windows

if TYPE_CHECKING:
    from spelgen.emission.loading import EmittedModel

POINTS = 200
WIDENED = 0.5  # of the logs' range, to both sides: a model is used a little beyond its logs
LEAST_SCALE = 0.05  # of the largest gravity torque, for joints that gravity hardly loads


@dataclass(frozen=True, eq=False)
class UrdfRegularizer:
    """The URDF's variation of M, relative to the model's mean M at the start, and its gravity torque, at
    points q (S, n).
    """

    q: torch.Tensor
    whitening: torch.Tensor  # (n, n)
    variation: torch.Tensor  # (S, n, n)
    gravity: torch.Tensor  # (S, n)
    gravity_scale: torch.Tensor  # (n,)

    def loss(self, model: EmittedModel) -> torch.Tensor:
        """Mean squared deviation of the model, relative to the sizes of M and of the gravity torque; no unit."""
        variation = _variation(model.mass_matrix(self.q), self.whitening) - self.variation
        load = (model.gravity(self.q) - self.gravity) / self.gravity_scale
        return variation.square().sum(dim=(-2, -1)).mean() / load.shape[-1] + load.square().mean()

    def to(self, device: str | torch.device) -> UrdfRegularizer:
        """The same on another device."""
        parts = (self.q, self.whitening, self.variation, self.gravity, self.gravity_scale)
        return UrdfRegularizer(*(x.to(device) for x in parts))


def urdf_regularizer(
    urdf: Path, joints: Sequence[str], model: EmittedModel, windows: Windows
) -> UrdfRegularizer:
    """The regularizer of a URDF around the positions of ``windows``. Raises what Pinocchio raises, and ImportError
    without it.
    """
    dynamics = urdf_dynamics(urdf, joints)
    seen = windows.q.flatten(0, 1)
    low, high = seen.amin(dim=0), seen.amax(dim=0)
    low, high = low - WIDENED * (high - low), high + WIDENED * (high - low)
    generator = torch.Generator().manual_seed(0)
    q = low + (high - low) * torch.rand(POINTS, len(joints), dtype=seen.dtype, generator=generator)
    with torch.no_grad():
        whitening = torch.linalg.inv(torch.linalg.cholesky(model.mass_matrix(q).mean(dim=0)))
    gravity = dynamics.gravity(q)
    scale = gravity.square().mean(dim=0).sqrt()
    largest = scale.max().item()
    scale = scale.clamp(min=LEAST_SCALE * largest) if largest > 0 else torch.ones_like(scale)
    return UrdfRegularizer(q, whitening, _variation(dynamics.mass_matrix(q), whitening), gravity, scale)


def _variation(mass: torch.Tensor, whitening: torch.Tensor) -> torch.Tensor:
    """M - mean M, relative to what ``whitening`` takes to the identity."""
    return whitening @ (mass - mass.mean(dim=0)) @ whitening.mT
