"""Steps of bodies' weights that go straight where torques do: in the inertial parameters.

Torques are linear in these, and the weights stand for them by way of a Cholesky factor: a step straight in the weights
leaves the line that a Gauss-Newton step was computed along. Here it is taken along that line, short of bodies that
cannot be.
"""

from __future__ import annotations

import torch

from spelgen.runtime.rigid_body import body_factor
from spelgen.settings.tuning.fitting import TorqueTuning

TUNING = TorqueTuning()


def moved_bodies(raw: torch.Tensor, step: torch.Tensor) -> torch.Tensor:
    """Return weights (B, 10) after a step (B, 10), as `InertialParameters` has them.

    A body's pseudo-inertia is C S C^T, S = T T^T. To first order the step adds T (X + X^T) T^T to S, and that is what
    is added, or as much of it as keeps S positive definite.
    """
    row, column = torch.triu_indices(4, 4)
    weights, moves = torch.zeros(2, len(raw), 4, 4).double()
    weights[:, row, column], moves[:, row, column] = raw, step
    # a complex step differentiates to the last digit; forward mode would load torch's compiler, which takes seconds
    tiny = 1e-100
    stepped = body_factor(torch.complex(weights, tiny * moves))
    factor, change = stepped.real, stepped.imag / tiny
    relative = torch.linalg.solve_triangular(factor, change, upper=True)
    added = relative + relative.mT
    smallest = torch.linalg.eigvalsh(added)[:, 0]
    fraction = (TUNING.body_step / (-smallest).clamp(min=1e-12)).clamp(max=1.0)
    factor = factor @ upper_cholesky(torch.eye(4).double() + fraction[:, None, None] * added)
    return body_weights(factor)


def upper_cholesky(matrix: torch.Tensor) -> torch.Tensor:
    """Return the upper triangular U, (..., n, n), with U U^T the matrix."""
    lower: torch.Tensor = torch.linalg.cholesky(matrix.flip(-1, -2))
    return lower.flip(-1, -2)


def body_weights(factor: torch.Tensor) -> torch.Tensor:
    """Return the weights (B, 10) of which `body_factor` makes this factor (B, 4, 4)."""
    scale = factor.diagonal(dim1=-2, dim2=-1)
    sizes, mass = scale[:, :3].log(), scale[:, 3:].log()
    logarithms = torch.cat([sizes - mass, 2 * mass], dim=-1)
    weights = (factor / scale.unsqueeze(-1)).triu(1) + logarithms.diag_embed()
    row, column = torch.triu_indices(4, 4)
    return weights[:, row, column]
