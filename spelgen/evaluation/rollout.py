"""Forward simulation of a model from an initial state."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from spelgen.dynamics.protocol import RigidDynamics, integrable
from spelgen.fitting.rollout import roll_out
from spelgen.logs.windows import Windows
from spelgen.settings.fits import Solver


def rollout(
    model: RigidDynamics,
    q: Tensor,
    qd: Tensor,
    tau: Tensor,
    dt: float | Tensor,
    solver: Solver = "rk4",
    substeps: int = 1,
) -> tuple[Tensor, Tensor]:
    """Integrate the motion of a model under torques that are constant in each interval.

    Args:
        model: an emitted model or any other dynamics.
        q: (..., n) initial positions [rad, m].
        qd: (..., n) initial velocities [rad/s, m/s].
        tau: (..., T, n) torques of the T intervals [Nm, N].
        dt: length of the intervals [s], or of each interval (..., T).
        solver: ``rk4``: classical Runge-Kutta; ``dopri5``: adaptive steps of torchdiffeq.
        substeps: of rk4 in each interval.

    Returns:
        Positions and velocities, each (..., T + 1, n), the initial state included.
    """
    batch = np.broadcast_shapes(q.shape[:-1], tau.shape[:-2])
    samples, n = tau.shape[-2:]
    steps = torch.as_tensor(dt, dtype=q.dtype, device=q.device).expand(*batch, samples)
    q, qd = (x.expand(*batch, n).reshape(-1, 1, n) for x in (q, qd))
    inputs = tau.expand(*batch, samples, n).reshape(-1, samples, n)
    windows = Windows(steps.reshape(-1, samples), q, qd, inputs)
    positions, velocities = roll_out(integrable(model), windows, substeps, solver)
    shape = (*batch, samples + 1, n)
    positions = torch.cat([q, positions], dim=1).reshape(shape)
    return positions, torch.cat([qd, velocities], dim=1).reshape(shape)
