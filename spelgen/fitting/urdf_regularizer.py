"""Regularizer towards the mass matrix and gravity torque of a URDF, for parameters that the logs do not determine.

The variation of M with q is compared, not its mean: URDFs do not specify the inertias of rotors, which add constants to
M.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from spelgen.dynamics.pinocchio_dynamics import urdf_dynamics
from spelgen.emission.assemble import ArmModel
from spelgen.errors import Diagnostic, in_one_line
from spelgen.fitting.tuning import TUNING
from spelgen.logs.windows import Windows


class UrdfRegularizer(NamedTuple):
    """Mass matrices and gravity torques of a URDF at S positions, to which a model is compared.

    Attributes:
        q: (S, n), positions [rad, m].
        whitening: (n, n), W, the inverse Cholesky factor of the mean over the positions of the model's mass matrix
            before the fit.
        variation: (S, n, n), dimensionless, W (M - mean M) W^T with the mass matrix M of the URDF and the mean of M
            over the S positions.
        gravity: (S, n), gravity torque of the URDF [Nm, N].
        gravity_scale: (n,), root mean square of `gravity` with a lower bound, by which errors of the gravity torque are
            divided [Nm, N].
    """

    q: Tensor
    whitening: Tensor
    variation: Tensor
    gravity: Tensor
    gravity_scale: Tensor

    def loss(self, model: ArmModel) -> Tensor:
        """Return the mean squared difference between model and URDF, a dimensionless scalar.

        The loss is the mean over the positions `q` of |W (M - mean M) W^T - `variation`|^2 / n + |(g - `gravity`) /
        `gravity_scale`|^2 / n. M and g are the mass matrix and the gravity torque of the model, mean M is the mean over
        the positions, W is `whitening`, and |.| is the Frobenius norm. `variation` and `gravity` are the URDF's values
        of W (M - mean M) W^T and g.
        """
        variation = _variation(model.mass_matrix(self.q), self.whitening) - self.variation
        gravity = (model.gravity(self.q) - self.gravity) / self.gravity_scale
        return variation.square().sum(dim=(-2, -1)).mean() / gravity.shape[-1] + gravity.square().mean()

    def to(self, device: str | torch.device) -> UrdfRegularizer:
        """Return the regularizer on another device."""
        return UrdfRegularizer(*(x.to(device) for x in self))


def urdf_regularizer(
    urdf: Path | None, model: ArmModel, windows: Windows, notes: list[Diagnostic]
) -> UrdfRegularizer | None:
    """Return the regularizer towards a URDF; None without a URDF.

    If the URDF cannot be read, a message is appended to ``notes``, and the result is None. windows: windows of the
    logs. The mass matrices and gravity torques of model and URDF are compared at random positions, within the range of
    the windows' positions plus a margin.
    """
    if urdf is None or not urdf.exists():
        return None
    try:
        return _at_random_positions(urdf, model, windows)
    # Pinocchio and its parser raise exceptions of many types; the fit continues without a regularizer
    except Exception as error:
        message = f"fitted without the URDF's regularizer: {in_one_line(error)}"
        notes.append(Diagnostic("info", "no-regularizer", urdf.name, None, message))
        return None


def _at_random_positions(urdf: Path, model: ArmModel, windows: Windows) -> UrdfRegularizer:
    """Return the regularizer of a URDF at random positions within the logged range of positions plus a margin.

    Args:
        urdf: URDF file.
        model: model before the fit. Mass matrices are made dimensionless by the mean of its M over the positions.
        windows: windows of the logs, whose positions define the range.

    Raises:
        ImportError: if Pinocchio is not installed. Errors of Pinocchio are raised, too.
    """
    dynamics = urdf_dynamics(urdf, model.joint_names)
    positions = windows.q.flatten(0, 1)
    low, high = positions.amin(dim=0), positions.amax(dim=0)
    margin = TUNING.regularizer_margin * (high - low)
    low, high = low - margin, high + margin
    # the seed is fixed, so that repeated fits have the same regularizer
    generator, shape = torch.Generator().manual_seed(0), (TUNING.regularizer_points, model.n)
    q = low + (high - low) * torch.rand(shape, dtype=positions.dtype, generator=generator)
    with torch.no_grad():
        whitening = torch.linalg.inv(torch.linalg.cholesky(model.mass_matrix(q).mean(dim=0)))
    gravity = dynamics.gravity(q)
    scale = gravity.square().mean(dim=0).sqrt()
    # If no joint has a gravity torque, the errors of the gravity torque are divided by 1.
    scale = scale.clamp(min=TUNING.min_gravity_scale * scale.max().item() or 1.0)
    return UrdfRegularizer(q, whitening, _variation(dynamics.mass_matrix(q), whitening), gravity, scale)


def _variation(mass: Tensor, whitening: Tensor) -> Tensor:
    """Return W (M - mean M) W^T, (S, n, n), for S mass matrices M, (S, n, n), and the whitening matrix W, (n, n)."""
    return whitening @ (mass - mass.mean(dim=0)) @ whitening.mT
