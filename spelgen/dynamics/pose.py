"""Equations of motion at a position, M qdd = force, with all that depends on the position alone worked out once."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from spelgen.dynamics.protocol import known_past


@dataclass(frozen=True, eq=False)
class Pose:
    """Dynamics at positions (W, n). mass: M, (W, n, n). force: of (qd, tau, z), what M qdd is, (W, n). friction: of
    (qd, z), what friction takes, (W, n).
    """

    mass: Tensor
    force: Callable[[Tensor, Tensor, Tensor], Tensor]
    friction: Callable[[Tensor, Tensor], Tensor]


PoseAt = Callable[[Tensor], Pose]


def poses(dynamics: Any) -> PoseAt:
    """Return what gives these dynamics at positions; weights must not change meanwhile."""
    if hasattr(dynamics, "nonlinear_at"):  # an emitted model
        return _of_weights(dynamics, dynamics.prepare())
    if hasattr(dynamics, "at"):
        pose_at: PoseAt = dynamics.at
        return pose_at
    return lambda q: _of_any(dynamics, q)


def _of_weights(model: Any, prepared: Any) -> PoseAt:
    """Return the poses of an emitted model."""

    def pose_at(q: Tensor) -> Pose:
        pose = model.configuration(q, prepared)
        mass, residuals = model.mass_at(pose, prepared)

        def friction(qd: Tensor, z: Tensor) -> Tensor:
            torque: Tensor = model.friction_at(pose, qd, prepared, *known_past(model, z))
            return torque

        def force(qd: Tensor, tau: Tensor, z: Tensor) -> Tensor:
            steady = model.nonlinear_at(pose, qd, residuals, prepared)
            left: Tensor = model.input_force(pose, qd, tau, prepared) - steady
            return left - friction(qd, z)

        return Pose(mass, force, friction)

    return pose_at


def _of_any(dynamics: Any, q: Tensor) -> Pose:
    mass = torch.as_tensor(dynamics.mass_matrix(q))

    def friction(qd: Tensor, z: Tensor) -> Tensor:
        return torch.as_tensor(dynamics.friction_torque(q, qd, *known_past(dynamics, z)))

    def force(qd: Tensor, tau: Tensor, z: Tensor) -> Tensor:
        qdd = torch.as_tensor(dynamics.forward_dynamics(q, qd, tau, *known_past(dynamics, z)))
        return (mass @ qdd.unsqueeze(-1)).squeeze(-1)

    return Pose(mass, force, friction)
