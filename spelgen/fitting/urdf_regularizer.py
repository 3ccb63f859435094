"""Regularizer towards the mass matrix and gravity torque of a URDF, for directions that the logs do not determine.

The variation of M with q is compared, not its mean: rotors and loads that the URDF does not specify add constants.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from spelgen.dynamics.pinocchio_dynamics import urdf_dynamics
from spelgen.emission.assemble import ArmModel
from spelgen.errors import Diagnostic
from spelgen.fitting.tuning import TUNING
from spelgen.logs.windows import Windows


class UrdfRegularizer(NamedTuple):
    """Variation of M and gravity torque of a URDF at S positions.

    q: (S, n) [rad, m]. whitening: (n, n), inverse Cholesky factor of the model's mean M before the fit. variation:
    (S, n, n) of M, whitened. gravity: (S, n) [Nm, N]. gravity_scale: (n,) [Nm, N], unit of its errors.
    """

    q: Tensor
    whitening: Tensor
    variation: Tensor
    gravity: Tensor
    gravity_scale: Tensor

    def loss(self, model: ArmModel) -> Tensor:
        """Return the mean squared difference of the model in M and in the gravity torque, (), both without unit."""
        variation = _variation(model.mass_matrix(self.q), self.whitening) - self.variation
        gravity = (model.gravity(self.q) - self.gravity) / self.gravity_scale
        return variation.square().sum(dim=(-2, -1)).mean() / gravity.shape[-1] + gravity.square().mean()

    def to(self, device: str | torch.device) -> UrdfRegularizer:
        """Return the regularizer on another device."""
        return UrdfRegularizer(*(x.to(device) for x in self))


def urdf_regularizer(
    urdf: Path | None, model: ArmModel, windows: Windows, notes: list[Diagnostic]
) -> UrdfRegularizer | None:
    """Return the regularizer towards a URDF; None without one, or with a note if it cannot be read."""
    if urdf is None or not urdf.exists():
        return None
    try:
        return _at_random_positions(urdf, model, windows)
    # Pinocchio and its parser raise many types; the fit continues without a regularizer
    except Exception as error:
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        message = f"fitted without the URDF's regularizer: {reason}"
        notes.append(Diagnostic("info", "no-regularizer", urdf.name, None, message))
        return None


def _at_random_positions(urdf: Path, model: ArmModel, windows: Windows) -> UrdfRegularizer:
    """Return the regularizer of a URDF at random positions in the range of a log.

    Args:
        urdf: file.
        model: its mean M before the fit is the unit of M.
        windows: positions (W, K, n) [rad, m], whose range is widened.

    Raises:
        ImportError: without Pinocchio, whose own errors are raised too.
    """
    dynamics = urdf_dynamics(urdf, model.joint_names)
    positions = windows.q.flatten(0, 1)
    low, high = positions.amin(dim=0), positions.amax(dim=0)
    margin = TUNING.regularizer_margin * (high - low)
    low, high = low - margin, high + margin
    # a fixed seed: the same fit twice has the same regularizer
    generator, shape = torch.Generator().manual_seed(0), (TUNING.regularizer_points, model.n)
    q = low + (high - low) * torch.rand(shape, dtype=positions.dtype, generator=generator)
    with torch.no_grad():
        whitening = torch.linalg.inv(torch.linalg.cholesky(model.mass_matrix(q).mean(dim=0)))
    gravity = dynamics.gravity(q)
    scale = gravity.square().mean(dim=0).sqrt()
    # without a gravity torque at any joint the unit is arbitrary
    scale = scale.clamp(min=TUNING.min_gravity_scale * scale.max().item() or 1.0)
    return UrdfRegularizer(q, whitening, _variation(dynamics.mass_matrix(q), whitening), gravity, scale)


def _variation(mass: Tensor, whitening: Tensor) -> Tensor:
    """Return W (M - mean M) W^T, (S, n, n), of M (S, n, n) and the whitening W (n, n)."""
    return whitening @ (mass - mass.mean(dim=0)) @ whitening.mT
