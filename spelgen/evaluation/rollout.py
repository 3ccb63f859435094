"""Motion of a model from one state under given inputs."""

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
    """Return positions and velocities, (..., T + 1, n), from q and qd (..., n) on, under tau (..., T, n).

    tau[k] is constant for dt [s], or for dt[k] of (..., T). ``model``: an emitted one or any other dynamics. solver:
    ``rk4`` takes ``substeps`` steps of the classical Runge-Kutta method in each dt, ``dopri5`` torchdiffeq's
    adaptive steps.
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
