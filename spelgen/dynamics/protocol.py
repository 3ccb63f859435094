"""The common interface of dynamics of an arm: trained models, Pinocchio, and bodies with least-squares parameters."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol, TypeGuard, runtime_checkable

import torch

from spelgen.runtime.port_hamiltonian import PortHamiltonian
from spelgen.runtime.residual_terms import ResidualDynamics, ResidualTerms
from spelgen.runtime.rigid_body_dynamics import RigidBodyDynamics

if TYPE_CHECKING:
    from torch import Tensor


class RigidDynamics(Protocol):
    """Dynamics M(q) qdd + h(q, qd) + friction(q, qd) = G tau of n joints; q, qd, qdd and tau are (..., n).

    Units: rad and Nm for revolute joints, m and N for prismatic joints; M in kg m^2, kg m and kg.
    """

    @property
    def n(self) -> int:
        """Number of joints."""

    def mass_matrix(self, q: Tensor) -> Tensor:
        """Return the mass matrix M, (..., n, n), armature included."""

    def gravity(self, q: Tensor) -> Tensor:
        """Return the gravity torque dV/dq, (..., n)."""

    def nonlinear_effects(self, q: Tensor, qd: Tensor) -> Tensor:
        """Return h, (..., n): Coriolis, centrifugal and gravity torques without friction."""

    def friction_torque(self, q: Tensor, qd: Tensor) -> Tensor:
        """Return the friction torque, (..., n)."""

    def forward_dynamics(self, q: Tensor, qd: Tensor, tau: Tensor) -> Tensor:
        """Return the accelerations qdd, (..., n), under the inputs tau."""

    def inverse_dynamics(self, q: Tensor, qd: Tensor, qdd: Tensor) -> Tensor:
        """Return the inputs tau, (..., n), for the accelerations qdd.

        A passive joint has no input: its element is the torque that a motor at the joint would need.
        """


@runtime_checkable
class FrictionState(Protocol):
    """Dynamics with a friction state: the deflections z of bristles, (..., n, elements) [rad, m]."""

    @property
    def elements(self) -> int:
        """Number of bristles per joint."""

    def memory(self, qd: Tensor) -> Tensor:
        """Return the friction state z, (..., n, elements), of joints that have moved at qd for a long time."""

    def memory_after(self, z: Tensor, displacement: Tensor) -> Tensor:
        """Return the friction state z after a monotonic displacement of the joints, (..., n) [rad, m]."""


def residual_terms(model: object) -> ResidualTerms | None:
    """Return the residual terms of a model; None for a model without residual terms."""
    return model.residuals if isinstance(model, ResidualDynamics) else None


def is_stateful(dynamics: object) -> TypeGuard[FrictionState]:
    """Return True if friction depends on the deflections z of bristles (friction state)."""
    if isinstance(dynamics, PortHamiltonian | VelocityState):  # isinstance of a protocol takes ten times as long
        return dynamics.elements > 0
    return isinstance(dynamics, FrictionState) and dynamics.elements > 0


def motors_of(model: Any) -> Tensor:
    """Return the matrix C, (n, n): the motor velocities are C qd; the identity if each motor drives its own joint."""
    return torch.eye(model.n).to(model.friction.nominal) if model.motors is None else model.motors


def sliding_memory(dynamics: object, qd: Tensor) -> Tensor:
    """Return the friction state z, (..., n, K), of joints that have moved at qd for a long time.

    K is the number of bristles per joint, 0 for friction without a state.
    """
    if not is_stateful(dynamics):
        return qd.unsqueeze(-1)[..., :0]
    return dynamics.memory(qd)


def memory_after(dynamics: object, z: Tensor, displacement: Tensor) -> Tensor:
    """Return the friction state z after a monotonic displacement of the joints, (..., n) [rad, m]."""
    if not z.shape[-1] or not is_stateful(dynamics):
        return z
    return dynamics.memory_after(z, displacement)


def memory_along(dynamics: object, q: Tensor, qd: Tensor, z: Tensor | None = None) -> Tensor:
    """Return the friction state z, (W, K, n, elements), at K samples q and qd, (W, K, n), of W windows.

    Between samples, q is interpolated linearly. z: initial state, (W, n, elements); None: the state of joints that have
    moved at the first qd for a long time.
    """
    states = [sliding_memory(dynamics, qd[:, 0]) if z is None else z]
    # The state at a sample depends on the state at the previous sample, so samples cannot be a batch.
    for moved in q.diff(dim=1).unbind(1):
        states.append(memory_after(dynamics, states[-1], moved))
    return torch.stack(states, dim=1)


def known_past(dynamics: object, z: Tensor | None, direction: Tensor | None = None) -> tuple[Tensor, ...]:
    """Return (z, direction), (z,) or (): the arguments that describe past motion to the methods of `dynamics`.

    Args:
        z: friction state of K bristles per joint, (..., n, K) [rad, m]; omitted if friction has no state.
        direction: smooth sign of the velocity, (..., n), the factor of dry friction of joints without bristles. It is
            needed only if tau was filtered: it must have passed the same filter.
    """
    if z is None or not z.shape[-1] or not is_stateful(dynamics):
        return ()
    if direction is None or not isinstance(dynamics, RigidBodyDynamics):
        return (z,)
    return z, direction


class VelocityState:
    """Adapter for rollouts of dynamics that provide no momenta p: the methods of p use qd in its place."""

    def __init__(self, dynamics: RigidDynamics) -> None:
        self.dynamics: Any = dynamics
        # Rollouts also call the methods of the friction state on the adapter: they are copied from `dynamics`.
        self.elements = 0
        if is_stateful(dynamics):
            self.elements = dynamics.elements
            self.memory, self.memory_after = dynamics.memory, dynamics.memory_after

    def prepare(self) -> None:
        """Return None: these dynamics have no parameter cache."""

    def at(self, q: Tensor, prepared: None = None) -> Tensor:
        """Return q, (..., n): these dynamics have no configuration cache."""
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
    """Return `dynamics` in a form for rollouts: unchanged if it has momenta, otherwise wrapped in `VelocityState`."""
    return dynamics if isinstance(dynamics, PortHamiltonian | VelocityState) else VelocityState(dynamics)
