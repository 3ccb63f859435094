"""The interface of all dynamics of an arm: assembled models, models of Pinocchio, models of least squares."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol, TypeGuard, runtime_checkable

import torch

from spelgen.runtime.port_hamiltonian import PortHamiltonian
from spelgen.runtime.residual_terms import ResidualDynamics, ResidualTerms
from spelgen.runtime.rigid_body_dynamics import RigidBodyDynamics

if TYPE_CHECKING:
    from torch import Tensor


class RigidDynamics(Protocol):
    """M(q) qdd + h(q, qd) + friction(q, qd) = G tau of n joints; q, qd, qdd, tau are (..., n).

    Units: rad, m; Nm, N; kg m^2, kg m, kg.
    """

    @property
    def n(self) -> int:
        """Number of joints."""

    def mass_matrix(self, q: Tensor) -> Tensor:
        """Return M, (..., n, n), with armature."""

    def gravity(self, q: Tensor) -> Tensor:
        """Return dV/dq, (..., n)."""

    def nonlinear_effects(self, q: Tensor, qd: Tensor) -> Tensor:
        """Return h, (..., n): Coriolis, centrifugal and gravity torques without friction."""

    def friction_torque(self, q: Tensor, qd: Tensor) -> Tensor:
        """Return the friction torque, (..., n)."""

    def forward_dynamics(self, q: Tensor, qd: Tensor, tau: Tensor) -> Tensor:
        """Return qdd, (..., n), under the inputs tau."""

    def inverse_dynamics(self, q: Tensor, qd: Tensor, qdd: Tensor) -> Tensor:
        """Return the inputs, (..., n), for the accelerations qdd; at a passive joint, the torque required there."""


@runtime_checkable
class FrictionState(Protocol):
    """Friction that depends on the state z of bristles, (..., n, elements) [rad, m]."""

    @property
    def elements(self) -> int:
        """Bristles per joint."""

    def memory(self, qd: Tensor) -> Tensor:
        """Return z, (..., n, elements), of joints that have moved at qd for a long time."""

    def memory_after(self, z: Tensor, displacement: Tensor) -> Tensor:
        """Return z after a monotonic displacement of the joints, (..., n)."""


def residual_terms(model: object) -> ResidualTerms | None:
    """Return the residual terms of a model; None for a model without residual terms."""
    return model.residuals if isinstance(model, ResidualDynamics) else None


def is_stateful(dynamics: object) -> TypeGuard[FrictionState]:
    """Return True if friction depends on the state z of bristles, the last argument of all calls."""
    return isinstance(dynamics, FrictionState) and dynamics.elements > 0


def motors_of(model: Any) -> Tensor:
    """Return C, (n, n): the motors rotate at C qd; the identity if each motor drives its own joint."""
    return torch.eye(model.n).to(model.friction.nominal) if model.motors is None else model.motors


def sliding_memory(dynamics: object, qd: Tensor) -> Tensor:
    """Return z, (..., n, K), of joints that have moved at qd for a long time; K = 0 for friction without a state."""
    if not is_stateful(dynamics):
        return qd.unsqueeze(-1)[..., :0]
    return dynamics.memory(qd)


def memory_after(dynamics: object, z: Tensor, displacement: Tensor) -> Tensor:
    """Return z after a monotonic displacement of the joints, (..., n)."""
    if not z.shape[-1] or not is_stateful(dynamics):
        return z
    return dynamics.memory_after(z, displacement)


def memory_along(dynamics: object, q: Tensor, qd: Tensor, z: Tensor | None = None) -> Tensor:
    """Return z, (W, K, n, elements), along the samples q and qd, (W, K, n), which are connected by straight lines.

    z: initial state, (W, n, elements); None: of joints that have moved at the first qd for a long time.
    """
    states = [sliding_memory(dynamics, qd[:, 0]) if z is None else z]
    # the state after a sample depends on the state before it: no batch over samples
    for moved in q.diff(dim=1).unbind(1):
        states.append(memory_after(dynamics, states[-1], moved))
    return torch.stack(states, dim=1)


def known_past(dynamics: object, z: Tensor | None, direction: Tensor | None = None) -> tuple[Tensor, ...]:
    """Return the arguments of the history of friction, the last of each call: z, if friction has a state, and the
    direction.

    direction: of dry friction without bristles, (..., n); required for a filtered tau, and filtered as tau is.
    """
    if z is None or not is_stateful(dynamics):
        return ()
    if direction is None or not isinstance(dynamics, RigidBodyDynamics):
        return (z,)
    return z, direction


class VelocityState:
    """Any dynamics with velocities in place of momenta, for rollouts."""

    def __init__(self, dynamics: RigidDynamics) -> None:
        self.dynamics: Any = dynamics
        # the friction state is passed through: rollouts read it from these dynamics
        self.elements = 0
        if is_stateful(dynamics):
            self.elements = dynamics.elements
            self.memory, self.memory_after = dynamics.memory, dynamics.memory_after

    def prepare(self) -> None:
        """Return None: there is no parameter cache."""

    def at(self, q: Tensor, prepared: None = None) -> Tensor:
        """Return q, (..., n): there is no configuration cache."""
        return q

    def momentum(self, q: Tensor, qd: Tensor) -> Tensor:
        """Return qd, (..., n), in place of momenta."""
        return qd

    def velocity(self, q: Tensor, p: Tensor) -> Tensor:
        """Return qd, (..., n): p is a velocity here."""
        return p

    def port_hamiltonian_rhs(
        self, q: Tensor, p: Tensor, tau: Tensor | None, prepared: None, z: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Return qd and qdd, (..., n) each."""
        past = known_past(self.dynamics, z)
        return p, self.dynamics.forward_dynamics(q, p, torch.zeros_like(q) if tau is None else tau, *past)


def integrable(dynamics: RigidDynamics) -> Any:
    """Return the dynamics that a rollout integrates: in momenta if they have them, else in velocities."""
    return dynamics if isinstance(dynamics, PortHamiltonian | VelocityState) else VelocityState(dynamics)
