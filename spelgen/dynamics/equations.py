"""Equations of motion M qdd = force: at a position, with M as a network gives it, and one step of them in time."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn

from spelgen.dynamics.protocol import known_past, memory_after
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
    if isinstance(dynamics, PortHamiltonian):
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


def runge_kutta(
    dynamics: object,
    rhs: Callable[[Tensor, Tensor, Tensor], tuple[Tensor, Tensor]],
    q: Tensor,
    p: Tensor,
    z: Tensor,
    step: Tensor | float,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return q, p and z after one `step` [s], and q' at its start (Hairer et al., Solving ODEs I, II.1).

    rhs: q' and p' of these dynamics by q, p and z. p: momenta, or velocities. Friction's memory z, (..., n, K), follows
    the displacement exactly, so it needs no stages of its own.
    """

    qd1 = qd = pd = torch.zeros_like(p)
    moved = pushed = torch.zeros_like(p)
    # where in the step a stage is, and its weight
    for fraction, weight in ((0.0, 1), (0.5, 2), (0.5, 2), (1.0, 1)):
        stage = fraction * step
        qd, pd = rhs(q + stage * qd, p + stage * pd, memory_after(dynamics, z, stage * qd))
        if fraction == 0:
            qd1 = qd
        moved, pushed = moved + weight * qd, pushed + weight * pd
    moved = step / 6 * moved
    return q + moved, p + step / 6 * pushed, memory_after(dynamics, z, moved), qd1


def unbounded(mass: Tensor) -> Tensor:
    """Return one for every matrix: all of M's changes stand, see ``DerivedMass.fraction``."""
    return mass.new_ones(mass.shape[:-2])


@contextmanager
def mass_as_learned(model: nn.Module) -> Iterator[None]:
    """Let the model's M be indefinite where its network says so; a model that bounds nothing stays as it is."""
    mass = getattr(model, "mass", None)
    if mass is None or not hasattr(mass, "fraction"):
        yield
        return
    mass.fraction = unbounded
    try:
        yield
    finally:
        del mass.fraction
