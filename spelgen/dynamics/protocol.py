"""What everything has that moves like an arm: emitted modules, Pinocchio's models, models of least squares."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol

import torch

if TYPE_CHECKING:
    from torch import Tensor


class RigidDynamics(Protocol):
    """M(q) qdd + h(q, qd) + friction(q, qd) = G tau of n joints; q, qd, qdd, tau are (..., n).

    Units: rad, m; Nm, N; kg m^2, kg m, kg.
    """

    @property
    def n(self) -> int:
        """How many joints."""

    def mass_matrix(self, q: Tensor) -> Tensor:
        """M, (..., n, n), armature included."""

    def gravity(self, q: Tensor) -> Tensor:
        """dV/dq, (..., n)."""

    def nonlinear_effects(self, q: Tensor, qd: Tensor) -> Tensor:
        """h: Coriolis, centrifugal and gravity torques without friction, (..., n)."""

    def friction_torque(self, q: Tensor, qd: Tensor) -> Tensor:
        """What friction takes, (..., n)."""

    def forward_dynamics(self, q: Tensor, qd: Tensor, tau: Tensor) -> Tensor:
        """qdd, (..., n), under the inputs tau."""

    def inverse_dynamics(self, q: Tensor, qd: Tensor, qdd: Tensor) -> Tensor:
        """The inputs, (..., n), that make qdd; those of a passive joint are the torques that it lacks."""


class PortHamiltonianDynamics(RigidDynamics, Protocol):
    """Dynamics with momenta p = M(q) qd as their state, as emitted modules have them.

    ``prepared`` is what ``prepare`` gave: all that depends on the weights alone.
    """

    def prepare(self, definite: bool = True) -> Any:
        """What many evaluations with the same weights share."""

    def momentum(self, q: Tensor, qd: Tensor, prepared: Any = None) -> Tensor:
        """p, (..., n)."""

    def velocity(self, q: Tensor, p: Tensor, prepared: Any = None) -> Tensor:
        """qd, (..., n)."""

    def port_hamiltonian_rhs(
        self, q: Tensor, p: Tensor, tau: Tensor | None, prepared: Any, z: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """q' and p', (..., n), under the inputs tau; without, of the arm left to itself."""


def remembering(dynamics: Any) -> Any:
    """What knows of friction's memory z, which all that depends on friction then takes last; None: nothing does."""
    owner = getattr(dynamics, "dynamics", dynamics)  # an emitted model's, or of least squares
    return owner if getattr(owner, "elements", 0) else None


def sliding_memory(dynamics: Any, qd: Tensor) -> Tensor:
    """z, (..., n, K), of joints that have long gone the way of qd."""
    owner = remembering(dynamics)
    found: Tensor = qd.unsqueeze(-1)[..., :0] if owner is None else owner.memory(qd)
    return found


def memory_after(dynamics: Any, z: Tensor, displacement: Tensor) -> Tensor:
    """z after joints went one way by (..., n)."""
    owner = remembering(dynamics) if z.shape[-1] else None  # asked four times a step
    found: Tensor = z if owner is None else owner.memory_after(z, displacement)
    return found


def memory_along(dynamics: Any, q: Tensor, qd: Tensor, z: Tensor | None = None) -> Tensor:
    """z, (W, K, n, elements), along the samples q and qd, (W, K, n), each straight to the next.

    It starts at z, (W, n, elements), by default as of joints that have long gone the way of the first qd.
    """
    found = [sliding_memory(dynamics, qd[:, 0]) if z is None else z]
    for moved in q.diff(dim=1).unbind(1):
        found.append(memory_after(dynamics, found[-1], moved))
    return torch.stack(found, dim=1)


def known_past(dynamics: Any, z: Tensor | None) -> tuple[Tensor, ...]:
    """z as what to give to these dynamics last, where they have a use for it."""
    return () if z is None or remembering(dynamics) is None else (z,)


class VelocityState:
    """Any dynamics where momenta are asked for: velocities take their place."""

    def __init__(self, dynamics: RigidDynamics) -> None:
        self.dynamics: Any = dynamics

    def prepare(self, definite: bool = True) -> None:
        """Nothing."""

    def momentum(self, q: Tensor, qd: Tensor, prepared: None = None) -> Tensor:
        """qd."""
        return qd

    def velocity(self, q: Tensor, p: Tensor, prepared: None = None) -> Tensor:
        """qd."""
        return p

    def port_hamiltonian_rhs(
        self, q: Tensor, p: Tensor, tau: Tensor | None, prepared: None, z: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """qd and qdd."""
        past = known_past(self.dynamics, z)
        return p, self.dynamics.forward_dynamics(q, p, torch.zeros_like(q) if tau is None else tau, *past)


def integrable(dynamics: RigidDynamics) -> Any:
    """What a rollout integrates: the dynamics in momenta where they have these, else in velocities."""
    return dynamics if hasattr(dynamics, "momentum") else VelocityState(dynamics)
