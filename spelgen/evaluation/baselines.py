"""What predicts: a model or any other dynamics, and what it is judged beside on the same windows."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from spelgen.dynamics.protocol import RigidDynamics, integrable
from spelgen.fitting.rollout import roll_out
from spelgen.logs.windows import Windows

MODEL = "model"  # the trained model among the predictors


@dataclass(frozen=True)
class Predictor:
    """Something that predicts.

    states: windows of K samples -> predicted q, qd, both (W, K-1, n), from the first sample and the inputs.
    torque: q, qd, qdd, each (T, n) -> tau (T, n); None for what has no dynamics.
    """

    name: str
    states: Callable[[Windows], tuple[torch.Tensor, torch.Tensor]]
    torque: Callable[[torch.Tensor, torch.Tensor, torch.Tensor], torch.Tensor] | None


def of_dynamics(name: str, dynamics: RigidDynamics, substeps: int) -> Predictor:
    """Dynamics as a predictor, all by the same integrator."""
    form = integrable(dynamics)
    return Predictor(name, lambda windows: roll_out(form, windows, substeps), dynamics.inverse_dynamics)


def constant_velocity() -> Predictor:
    """The first velocity stays: what any model of short horizons must beat."""

    def hold(windows: Windows) -> tuple[torch.Tensor, torch.Tensor]:
        elapsed = windows.dt.cumsum(dim=1).unsqueeze(-1)  # (W, K-1, 1)
        qd = windows.qd[:, :1]
        return windows.q[:, :1] + qd * elapsed, qd.expand(-1, elapsed.shape[1], -1)

    return Predictor("velocity stays constant", hold, None)


def of_urdf(urdf: Path, joints: Sequence[str], substeps: int) -> Predictor:
    """Rigid bodies with the URDF's own inertials, damping and friction, by Pinocchio.

    Raises what Pinocchio raises where it cannot read the file, and ImportError without Pinocchio.
    """
    from spelgen.dynamics.pinocchio_urdf import urdf_dynamics  # an extra: everything else here works without

    return of_dynamics("URDF", urdf_dynamics(urdf, joints), substeps)
