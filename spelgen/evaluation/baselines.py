"""What predicts: a model or any other dynamics, and what it is judged beside on the same windows."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from spelgen.dynamics.protocol import RigidDynamics, integrable, known_past
from spelgen.evaluation.names import CONSTANT_VELOCITY, URDF, URDF_WITH_DRIVES
from spelgen.evaluation.stiff import Solver, States, accurate_solver
from spelgen.fitting.rollout import roll_out
from spelgen.logs.windows import Windows


@dataclass(frozen=True)
class Predictor:
    """Something that predicts.

    states: windows of K samples, and where wanted a disturbance (W, n) -> predicted q, qd, both (W, K-1, n), from the
    first sample and the inputs. torque: q, qd, qdd, each (T, n), and z (T, n, K) -> tau (T, n). dynamics: these. form:
    what is integrated, to whose p' a disturbance is added. The last three are None for what has no dynamics.
    """

    name: str
    states: Callable[..., States]
    torque: Callable[..., torch.Tensor] | None = None
    dynamics: RigidDynamics | None = None
    form: Any = None


def of_dynamics(name: str, dynamics: RigidDynamics, substeps: int) -> Predictor:
    """Dynamics as a predictor, by the classical Runge-Kutta method."""
    return _of_solver(name, dynamics, Solver(integrable(dynamics), roll_out, substeps))


def of_baseline(name: str, dynamics: RigidDynamics, probe: Windows) -> Predictor:
    """Dynamics that are not the model's as a predictor: by steps of their own, as many as they need on the probe."""
    return _of_solver(name, dynamics, accurate_solver(dynamics, probe))


def _of_solver(name: str, dynamics: RigidDynamics, solver: Solver) -> Predictor:
    return Predictor(name, solver, _inverse_dynamics(dynamics), dynamics, solver.form)


def _inverse_dynamics(dynamics: Any) -> Callable[..., torch.Tensor]:
    """That of these, which may or may not have a use for friction's memory z."""

    def torque(
        q: torch.Tensor, qd: torch.Tensor, qdd: torch.Tensor, z: torch.Tensor | None = None
    ) -> torch.Tensor:
        found: torch.Tensor = dynamics.inverse_dynamics(q, qd, qdd, *known_past(dynamics, z))
        return found

    return torque


def constant_velocity() -> Predictor:
    """The first velocity stays: what any model of short horizons must beat."""

    def hold(windows: Windows) -> States:
        elapsed = windows.dt.cumsum(dim=1).unsqueeze(-1)  # (W, K-1, 1)
        qd = windows.qd[:, :1]
        return windows.q[:, :1] + qd * elapsed, qd.expand(-1, elapsed.shape[1], -1)

    return Predictor(CONSTANT_VELOCITY, hold)


def of_urdf(urdf: Path, joints: Sequence[str], probe: Windows) -> list[Predictor]:
    """Rigid bodies as the URDF has them, with its damping and friction, by Pinocchio; and, where the settings beside
    it tell of drives, with their friction and rotors.

    Raises what Pinocchio raises where it cannot read the file, and ImportError without Pinocchio.
    """
    from spelgen.dynamics.pinocchio_urdf import (
        has_drives,
        urdf_dynamics,
    )  # an extra: all else here works without

    found = [of_baseline(URDF, urdf_dynamics(urdf, joints), probe)]
    if has_drives(urdf, joints):
        found.append(of_baseline(URDF_WITH_DRIVES, urdf_dynamics(urdf, joints, drives=True), probe))
    return found
