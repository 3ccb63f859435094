"""Equations of motion M qdd = force at given positions, and one step of their integration."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol, runtime_checkable

import torch
from torch import Tensor, nn

from spelgen.dynamics.protocol import known_past, memory_after
from spelgen.runtime.derived_mass import DerivedMass
from spelgen.runtime.network_dynamics import NetworkDynamics
from spelgen.runtime.port_hamiltonian import PortHamiltonian


@dataclass(frozen=True, eq=False)
class MotionEquations:
    """Equations of motion of W rollouts at fixed positions (W, n).

    Attributes:
        mass: mass matrix M, (W, n, n).
        force: function of (qd, tau, z) that returns M qdd, (W, n) [Nm, N].
        friction: function of (qd, z) that returns the friction torque, (W, n) [Nm, N].
    """

    mass: Tensor
    force: Callable[[Tensor, Tensor, Tensor | None], Tensor]
    friction: Callable[[Tensor, Tensor | None], Tensor]


EquationsAt = Callable[[Tensor], MotionEquations]


@runtime_checkable
class OwnEquations(Protocol):
    """Dynamics that provide their own `equations_at`, which needs fewer operations than the general equations."""

    def equations_at(self, q: Tensor) -> MotionEquations:
        """Return the equations of motion at positions q, (W, n) [rad, m], of W rollouts."""


def equations_of(dynamics: object) -> EquationsAt:
    """Return a function of q (W, n) that returns the equations of motion of W rollouts at q.

    The function uses cached values of the parameters: it is valid until a parameter changes.
    """
    if isinstance(dynamics, PortHamiltonian):
        return partial(_of_model, dynamics, dynamics.prepare())
    return dynamics.equations_at if isinstance(dynamics, OwnEquations) else partial(_of_any, dynamics)


def _of_model(model: PortHamiltonian, prepared: object, q: Tensor) -> MotionEquations:
    """Return the equations of motion of W rollouts of a port-Hamiltonian model at q (W, n).

    prepared: parameter cache of the model.
    """
    pose = model.configuration(q, prepared)

    def friction(qd: Tensor, z: Tensor | None) -> Tensor:
        """Return the friction torque of W rollouts, (W, n) [Nm, N]."""
        return model.friction_torque(pose, qd, *known_past(model, z))

    def force(qd: Tensor, tau: Tensor, z: Tensor | None) -> Tensor:
        """Return the force M qdd of W rollouts, (W, n) [Nm, N]."""
        return model.input_force(pose, qd, tau) - model.nonlinear_effects(pose, qd) - friction(qd, z)

    return MotionEquations(pose.mass, force, friction)


def _of_any(dynamics: Any, q: Tensor) -> MotionEquations:
    """Return the equations of motion of W rollouts at q (W, n) for dynamics of any other class.

    The force M qdd is computed from the forward dynamics.
    """
    mass = torch.as_tensor(dynamics.mass_matrix(q))

    def friction(qd: Tensor, z: Tensor | None) -> Tensor:
        """Return the friction torque of W rollouts, (W, n) [Nm, N]."""
        return torch.as_tensor(dynamics.friction_torque(q, qd, *known_past(dynamics, z)))

    def force(qd: Tensor, tau: Tensor, z: Tensor | None) -> Tensor:
        """Return the force M qdd of W rollouts, (W, n) [Nm, N]."""
        # `RigidDynamics` has no method that returns M qdd, so the acceleration qdd is multiplied by M.
        qdd = torch.as_tensor(dynamics.forward_dynamics(q, qd, tau, *known_past(dynamics, z)))
        return (mass @ qdd.unsqueeze(-1)).squeeze(-1)

    return MotionEquations(mass, force, friction)


def runge_kutta(
    dynamics: object,
    rhs: Callable[[Tensor, Tensor, Tensor], tuple[Tensor, Tensor]],
    q: Tensor,
    p: Tensor,
    z: Tensor,
    step: Tensor | float,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return q, p and z after one step of the classical Runge-Kutta method, and dq/dt at the start of the step.

    Hairer et al., Solving ODEs I, II.1.

    Args:
        rhs: function of (q, p, z) that returns dq/dt and dp/dt.
        q: positions, (..., n) [rad, m].
        p: momenta or velocities, (..., n).
        z: friction state of K bristles per joint, (..., n, K); it is not integrated, but computed from the displacement
            of the joints.
        step: duration [s].
    """

    qd1 = qd = pd = torch.zeros_like(p)
    moved = pushed = torch.zeros_like(p)
    # For each stage, its time as a fraction of the step, and its weight in the mean.
    for fraction, weight in ((0.0, 1), (0.5, 2), (0.5, 2), (1.0, 1)):
        stage = fraction * step
        # z is the friction state at the start of the step; `memory_after` adds the displacement since then.
        qd, pd = rhs(q + stage * qd, p + stage * pd, memory_after(dynamics, z, stage * qd))
        if fraction == 0:
            qd1 = qd
        moved, pushed = moved + weight * qd, pushed + weight * pd
    moved = step / 6 * moved
    return q + moved, p + step / 6 * pushed, memory_after(dynamics, z, moved), qd1


def unbounded(mass: Tensor) -> Tensor:
    """Return the factor t = 1, (...), for mass matrices M, (..., n, n): an indefinite M is not corrected.

    The function replaces ``DerivedMass.fraction``, which returns t < 1 for an indefinite M.
    """
    return mass.new_ones(mass.shape[:-2])


@contextmanager
def mass_as_learned(model: nn.Module) -> Iterator[None]:
    """Context manager that switches off the correction of an indefinite M by ``DerivedMass``.

    Models with other mass matrices are unchanged.
    """
    mass = model.mass if isinstance(model, NetworkDynamics) else None
    if not isinstance(mass, DerivedMass):
        yield
        return
    # An attribute of the instance hides the method of its class, so that only this model is changed.
    vars(mass)["fraction"] = unbounded
    try:
        yield
    finally:
        del vars(mass)["fraction"]
