"""Equations of motion at a position, M qdd = force, with all that depends on the position alone worked out once."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor

from spelgen.dynamics.protocol import has_momentum, known_past
from spelgen.runtime.port_hamiltonian import PortHamiltonian


@dataclass(frozen=True, eq=False)
class Pose:
    """Hold dynamics at positions (W, n).

    mass: M, (W, n, n). force: of (qd, tau, z), what M qdd is, (W, n). friction: of (qd, z), what friction takes,
    (W, n).
    """

    mass: Tensor
    force: Callable[[Tensor, Tensor, Tensor | None], Tensor]
    friction: Callable[[Tensor, Tensor | None], Tensor]


PoseAt = Callable[[Tensor], Pose]


def poses(dynamics: object) -> PoseAt:
    """Return what gives these dynamics at positions; weights must not change meanwhile."""
    if has_momentum(dynamics):
        return partial(_of_weights, dynamics, dynamics.prepare())
    # dynamics by a regressor have their own
    pose_at: PoseAt = getattr(dynamics, "pose_at", partial(_of_any, dynamics))
    return pose_at


def _of_weights(model: PortHamiltonian, prepared: object, q: Tensor) -> Pose:
    """Return the pose of an emitted model."""
    pose = model.configuration(q, prepared)

    def friction(qd: Tensor, z: Tensor | None) -> Tensor:
        return model.friction_torque(pose, qd, *known_past(model, z))

    def force(qd: Tensor, tau: Tensor, z: Tensor | None) -> Tensor:
        return model.input_force(pose, qd, tau) - model.nonlinear_effects(pose, qd) - friction(qd, z)

    return Pose(pose.mass, force, friction)


def _of_any(dynamics: Any, q: Tensor) -> Pose:
    mass = torch.as_tensor(dynamics.mass_matrix(q))

    def friction(qd: Tensor, z: Tensor | None) -> Tensor:
        return torch.as_tensor(dynamics.friction_torque(q, qd, *known_past(dynamics, z)))

    def force(qd: Tensor, tau: Tensor, z: Tensor | None) -> Tensor:
        qdd = torch.as_tensor(dynamics.forward_dynamics(q, qd, tau, *known_past(dynamics, z)))
        return (mass @ qdd.unsqueeze(-1)).squeeze(-1)

    return Pose(mass, force, friction)
