"""A regularizer towards the URDF's own M and gravity, for where the logs say little.

How M varies with q is compared, not its mean: rotors and loads that the URDF leaves out add constants.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import torch

from spelgen.dynamics.pinocchio_urdf import urdf_dynamics
from spelgen.fitting.tuning import RegularizerTuning
from spelgen.logs.windows import Windows

if TYPE_CHECKING:
    from spelgen.emission.assemble import ArmModel

TUNING = RegularizerTuning()


class UrdfRegularizer(NamedTuple):
    """Hold the URDF's variation of M and its gravity torque at points q (S, n).

    The variation is relative to the model's mean M at the start.
    """

    q: torch.Tensor
    whitening: torch.Tensor  # (n, n)
    variation: torch.Tensor  # (S, n, n)
    gravity: torch.Tensor  # (S, n)
    gravity_scale: torch.Tensor  # (n,)

    def loss(self, model: ArmModel) -> torch.Tensor:
        """Mean squared deviation of the model, relative to the sizes of M and of the gravity torque; no unit."""
        variation = _variation(model.mass_matrix(self.q), self.whitening) - self.variation
        load = (model.gravity(self.q) - self.gravity) / self.gravity_scale
        return variation.square().sum(dim=(-2, -1)).mean() / load.shape[-1] + load.square().mean()

    def to(self, device: str | torch.device) -> UrdfRegularizer:
        """The same on another device."""
        return UrdfRegularizer(*(x.to(device) for x in self))


def urdf_regularizer(urdf: Path, joints: Sequence[str], model: ArmModel, windows: Windows) -> UrdfRegularizer:
    """Return the regularizer of a URDF around the positions of ``windows``.

    Raises what Pinocchio raises, and ImportError without it.
    """
    dynamics = urdf_dynamics(urdf, joints)
    positions = windows.q.flatten(0, 1)
    low, high = positions.amin(dim=0), positions.amax(dim=0)
    low, high = low - TUNING.widened * (high - low), high + TUNING.widened * (high - low)
    generator = torch.Generator().manual_seed(0)
    q = low + (high - low) * torch.rand(
        TUNING.points, len(joints), dtype=positions.dtype, generator=generator
    )
    with torch.no_grad():
        whitening = torch.linalg.inv(torch.linalg.cholesky(model.mass_matrix(q).mean(dim=0)))
    gravity = dynamics.gravity(q)
    scale = gravity.square().mean(dim=0).sqrt()
    largest = scale.max().item()
    floor = TUNING.least_scale * largest
    if not largest:
        floor = 1.0  # gravity loads no joint: any unit will do
    scale = scale.clamp(min=floor)
    return UrdfRegularizer(q, whitening, _variation(dynamics.mass_matrix(q), whitening), gravity, scale)


def _variation(mass: torch.Tensor, whitening: torch.Tensor) -> torch.Tensor:
    """M - mean M, relative to what ``whitening`` takes to the identity."""
    return whitening @ (mass - mass.mean(dim=0)) @ whitening.mT
