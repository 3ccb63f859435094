"""What a trained model is compared with on the same windows: a constant velocity, the URDF's own values."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import torch

from spelgen.dynamics.pinocchio_urdf import urdf_dynamics
from spelgen.dynamics.protocol import integrable
from spelgen.fitting.rollout import roll_out
from spelgen.logs.windows import Windows

if TYPE_CHECKING:
    from spelgen.fitting.run_folder import EmittedModel


@dataclass(frozen=True)
class Contender:
    """Something that predicts.

    roll_out: windows of K samples -> predicted q, qd, both (W, K-1, n), from the first sample and the inputs.
    torque: q, qd, qdd, each (T, n) -> tau (T, n); None for what has no dynamics.
    """

    name: str
    roll_out: Callable[[Windows], tuple[torch.Tensor, torch.Tensor]]
    torque: Callable[[torch.Tensor, torch.Tensor, torch.Tensor], torch.Tensor] | None


def trained(model: EmittedModel, substeps: int) -> Contender:
    """The model itself."""
    return Contender("model", lambda windows: roll_out(model, windows, substeps), model.inverse_dynamics)


def held_velocity() -> Contender:
    """The first velocity stays: what any model of short horizons must beat."""

    def hold(windows: Windows) -> tuple[torch.Tensor, torch.Tensor]:
        elapsed = windows.dt.cumsum(dim=1).unsqueeze(-1)  # (W, K-1, 1)
        qd = windows.qd[:, :1]
        return windows.q[:, :1] + qd * elapsed, qd.expand(-1, elapsed.shape[1], -1)

    return Contender("velocity stays constant", hold, None)


def urdf_values(urdf: Path, joints: Sequence[str], substeps: int) -> Contender:
    """Rigid bodies with the URDF's own inertials, damping and friction, by Pinocchio, in the same integrator.

    Raises what Pinocchio raises where it cannot read the file, and ImportError without Pinocchio.
    """
    dynamics = urdf_dynamics(urdf, joints)
    return Contender("URDF", lambda windows: roll_out(integrable(dynamics), windows, substeps), dynamics.inverse_dynamics)
