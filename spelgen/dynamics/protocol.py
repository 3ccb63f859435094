"""The common interface of an arm's dynamics: trained models, Pinocchio, and regressors with identified parameters.

Functions such as `memory_after` return the friction state z after a motion. They also accept dynamics without a
friction state, for which z is empty.
"""

from typing import Any, Protocol, TypeGuard, runtime_checkable

import torch
from torch import Tensor

from spelgen.runtime.port_hamiltonian import PortHamiltonian
from spelgen.runtime.residual_terms import ResidualDynamics, ResidualTerms
from spelgen.runtime.rigid_body_dynamics import RigidBodyDynamics


class RigidDynamics(Protocol):
    """Interface of dynamics of n joints: M(q) qdd + h(q, qd) + friction(q, qd) = G tau.

    M is the mass matrix, h the Coriolis, centrifugal and gravity torque, G the input matrix. Positions q, velocities
    qd, accelerations qdd and inputs tau are (..., n), in rad and Nm for revolute joints, in m and N for prismatic
    joints; M is in kg m^2, kg m and kg.
    """

    @property
    def n(self) -> int:
        """Number of joints."""

    def mass_matrix(self, q: Tensor) -> Tensor:
        """Return the mass matrix M, (..., n, n), armature included."""

    def gravity(self, q: Tensor) -> Tensor:
        """Return the gravity torque dV/dq, (..., n)."""

    def nonlinear_effects(self, q: Tensor, qd: Tensor) -> Tensor:
        """Return h, (..., n): Coriolis, centrifugal and gravity torque, without friction."""

    def friction_torque(self, q: Tensor, qd: Tensor) -> Tensor:
        """Return the friction torque, (..., n) [Nm, N]: term on the left side of the equation, with the sign of qd."""

    def forward_dynamics(self, q: Tensor, qd: Tensor, tau: Tensor) -> Tensor:
        """Return the accelerations qdd, (..., n), under the inputs tau."""

    def inverse_dynamics(self, q: Tensor, qd: Tensor, qdd: Tensor) -> Tensor:
        """Return the inputs tau, (..., n), that give the accelerations qdd, (..., n).

        A passive joint has no input: its element is the torque that a motor at the joint would need.
        """


@runtime_checkable
class FrictionState(Protocol):
    """Interface of dynamics with a friction state z: deflections of bristles, (..., n, elements) [rad, m]."""

    @property
    def elements(self) -> int:
        """Number of bristles per joint."""

    def memory(self, qd: Tensor) -> Tensor:
        """Return the friction state z after a long motion at constant velocities qd, (..., n) [rad/s, m/s].

        z: deflections of the bristles of each joint, (..., n, elements) [rad, m].
        """

    def memory_after(self, z: Tensor, displacement: Tensor) -> Tensor:
        """Return the friction state, (..., n, elements), after a displacement of the joints, (..., n) [rad, m].

        z is the friction state before the displacement, which has no reversals.
        """


def residual_terms(model: object) -> ResidualTerms | None:
    """Return the residual terms of a model; None for a model without residual terms."""
    return model.residuals if isinstance(model, ResidualDynamics) else None


def is_stateful(dynamics: object) -> TypeGuard[FrictionState]:
    """Return True if friction of ``dynamics`` depends on a friction state: the deflections z of bristles."""
    # The test of a class is first: isinstance of a protocol takes ten times as long.
    if isinstance(dynamics, PortHamiltonian | VelocityState):
        return dynamics.elements > 0
    return isinstance(dynamics, FrictionState) and dynamics.elements > 0


def motors_of(model: Any) -> Tensor:
    """Return the matrix C, (n, n), of a rigid-body model: its motors have the velocities C qd.

    C is the identity if each motor drives its own joint.
    """
    return torch.eye(model.n).to(model.friction.nominal) if model.motors is None else model.motors


def sliding_memory(dynamics: object, qd: Tensor) -> Tensor:
    """Return the friction state z of dynamics, (..., n, K) [rad, m], after a long motion at constant qd, (..., n).

    K is the number of bristles per joint, 0 for friction without a state: z is then empty. qd: [rad/s, m/s].
    """
    if not is_stateful(dynamics):
        return qd.unsqueeze(-1)[..., :0]
    return dynamics.memory(qd)


def memory_after(dynamics: object, z: Tensor, displacement: Tensor) -> Tensor:
    """Return the friction state, (..., n, K) [rad, m], after a displacement of the joints, (..., n) [rad, m].

    z is the friction state before the displacement, which has no reversals. An empty z (K = 0) is returned unchanged.
    """
    if not z.shape[-1] or not is_stateful(dynamics):
        return z
    return dynamics.memory_after(z, displacement)


def memory_along(dynamics: object, q: Tensor, qd: Tensor, z: Tensor | None = None) -> Tensor:
    """Return the friction state at each sample of W windows (intervals of a log), (W, S, n, elements) [rad, m].

    Between samples, q is interpolated linearly.

    Args:
        dynamics: dynamics with ``elements`` bristles per joint.
        q: positions at S samples of each window, (W, S, n) [rad, m].
        qd: velocities, (W, S, n) [rad/s, m/s]; only the first sample of a window is used.
        z: friction state at the first samples, (W, n, elements) [rad, m]; None: the state after a long motion at the
            first qd.
    """
    states = [sliding_memory(dynamics, qd[:, 0]) if z is None else z]
    # The friction state at a sample depends on the previous sample: a loop over the samples is needed.
    for moved in q.diff(dim=1).unbind(1):
        states.append(memory_after(dynamics, states[-1], moved))
    return torch.stack(states, dim=1)


def known_past(dynamics: object, z: Tensor | None, direction: Tensor | None = None) -> tuple[Tensor, ...]:
    """Return the friction arguments to pass to a method of `dynamics` after (q, qd, ...): (), (z,) or (z, direction).

    The result is () if z is None or friction has no state. It is (z, direction) only for a `RigidBodyDynamics` with a
    known direction, since other dynamics do not have the argument ``direction``; otherwise it is (z,).

    Args:
        dynamics: dynamics whose method is called.
        z: friction state of K bristles per joint, (..., n, K) [rad, m]; None: unknown.
        direction: smooth sign of the velocity, (..., n), the factor of dry friction of joints without bristles. A
            comparison with low-pass filtered torques needs the smooth sign after the same filter. None: computed from
            qd.
    """
    if z is None or not z.shape[-1] or not is_stateful(dynamics):
        return ()
    if direction is None or not isinstance(dynamics, RigidBodyDynamics):
        return (z,)
    return z, direction


class VelocityState:
    """Adapter for rollouts of dynamics without momenta: velocities qd replace the momenta p in all its methods."""

    def __init__(self, dynamics: RigidDynamics) -> None:
        self.dynamics: Any = dynamics
        # Rollouts call `memory` and `memory_after`, which compute the friction state, on the adapter as on a trained
        # model. The methods of `dynamics` become attributes of the adapter.
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
        """Return qd, (..., n), in place of momenta: the state of these dynamics is (q, qd), not (q, p)."""
        return qd

    def velocity(self, q: Tensor, p: Tensor) -> Tensor:
        """Return p, (..., n), unchanged: it is the velocity qd in this class."""
        return p

    def port_hamiltonian_rhs(
        self, q: Tensor, p: Tensor, tau: Tensor, prepared: None, z: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Return the time derivatives qd and qdd of the state (q, qd), (..., n) each; p is the velocity qd."""
        return p, self.dynamics.forward_dynamics(q, p, tau, *known_past(self.dynamics, z))


def integrable(dynamics: RigidDynamics) -> Any:
    """Return `dynamics` with the methods that rollouts call.

    A trained model (`PortHamiltonian`) has these methods and is returned unchanged. Other dynamics, such as baselines,
    are wrapped in `VelocityState`.
    """
    return dynamics if isinstance(dynamics, PortHamiltonian | VelocityState) else VelocityState(dynamics)
