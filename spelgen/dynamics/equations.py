"""Equations of motion M qdd = force at given positions for rollouts, and a step of the Runge-Kutta method."""

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
from spelgen.runtime.parts import applied
from spelgen.runtime.port_hamiltonian import PortHamiltonian


@dataclass(frozen=True, eq=False)
class MotionEquations:
    """Equations of motion of W rollouts at fixed positions q, (W, n), for several evaluations of the torques.

    Velocities qd and inputs tau are (W, n); z is the friction state of K bristles per joint, (W, n, K), or None.

    Attributes:
        mass: mass matrix M(q), (W, n, n).
        force: function of (qd, tau, z) that returns M qdd, (W, n) [Nm, N].
        friction: function of (qd, z) that returns the friction torque, (W, n) [Nm, N].
    """

    mass: Tensor
    force: Callable[[Tensor, Tensor, Tensor | None], Tensor]
    friction: Callable[[Tensor, Tensor | None], Tensor]


EquationsAt = Callable[[Tensor], MotionEquations]


@runtime_checkable
class OwnEquations(Protocol):
    """Dynamics with a method `equations_at`, which is faster than the general function `_of_dynamics`."""

    def equations_at(self, q: Tensor) -> MotionEquations:
        """Return M, force and friction torque (`MotionEquations`) of W rollouts at positions q, (W, n) [rad, m]."""


def equations_of(dynamics: object) -> EquationsAt:
    """Return a function of positions q, (W, n), that returns the equations of motion of W rollouts at q.

    The returned function uses a parameter cache of ``dynamics``: do not use the function after a parameter has changed.
    """
    if isinstance(dynamics, PortHamiltonian):
        return partial(_of_model, dynamics, dynamics.prepare())
    return dynamics.equations_at if isinstance(dynamics, OwnEquations) else partial(_of_dynamics, dynamics)


def _of_model(model: PortHamiltonian, prepared: object, q: Tensor) -> MotionEquations:
    """Return the equations of motion of W rollouts of a port-Hamiltonian model at positions q, (W, n).

    prepared: parameter cache, from ``model.prepare()``.
    """
    pose = model.configuration(q, prepared)

    def friction(qd: Tensor, z: Tensor | None) -> Tensor:
        """Return the friction torque, (W, n) [Nm, N], at the fixed positions q; qd, z: see `MotionEquations`."""
        return model.friction_torque(pose, qd, *known_past(model, z))

    def force(qd: Tensor, tau: Tensor, z: Tensor | None) -> Tensor:
        """Return the force M qdd, (W, n) [Nm, N], at the fixed positions q; qd, tau, z: see `MotionEquations`."""
        return model.input_force(pose, qd, tau) - model.nonlinear_effects(pose, qd) - friction(qd, z)

    return MotionEquations(pose.mass, force, friction)


def _of_dynamics(dynamics: Any, q: Tensor) -> MotionEquations:
    """Return the equations of motion of W rollouts at positions q, (W, n), for any ``RigidDynamics``."""
    mass = torch.as_tensor(dynamics.mass_matrix(q))

    def friction(qd: Tensor, z: Tensor | None) -> Tensor:
        """Return the friction torque, (W, n) [Nm, N], at the fixed positions q; qd, z: see `MotionEquations`."""
        return torch.as_tensor(dynamics.friction_torque(q, qd, *known_past(dynamics, z)))

    def force(qd: Tensor, tau: Tensor, z: Tensor | None) -> Tensor:
        """Return the force M qdd, (W, n) [Nm, N], at the fixed positions q; qd, tau, z: see `MotionEquations`."""
        # `RigidDynamics` has no method that returns the force M qdd, so the acceleration qdd is multiplied by M.
        qdd = torch.as_tensor(dynamics.forward_dynamics(q, qd, tau, *known_past(dynamics, z)))
        return applied(mass, qdd)

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
        dynamics: dynamics whose bristles are displaced; without bristles, z is returned unchanged.
        rhs: function of (q, p, z) that returns dq/dt and dp/dt.
        q: positions, (..., n) [rad, m].
        p: momenta or velocities, (..., n).
        z: friction state of K bristles per joint, (..., n, K); it is not integrated, but computed from the displacement
            of the joints.
        step: duration of the step [s].
    """
    qd1 = qd = pd = torch.zeros_like(p)
    moved = pushed = torch.zeros_like(p)
    # For each stage of the Runge-Kutta method: its time as a fraction of the step, and its weight in the mean rate.
    for fraction, weight in ((0.0, 1), (0.5, 2), (0.5, 2), (1.0, 1)):
        stage = fraction * step
        # z is the friction state at the start of the step; `memory_after` adds the displacement up to the stage.
        qd, pd = rhs(q + stage * qd, p + stage * pd, memory_after(dynamics, z, stage * qd))
        if fraction == 0:
            qd1 = qd
        moved, pushed = moved + weight * qd, pushed + weight * pd
    moved = step / 6 * moved
    return q + moved, p + step / 6 * pushed, memory_after(dynamics, z, moved), qd1


def unbounded(mass: Tensor) -> Tensor:
    """Return the factor t = 1, (...), for mass matrices M, (..., n, n): M is not corrected.

    ``DerivedMass`` replaces M by C + t (M - C), with a constant matrix C. The method ``DerivedMass.fraction`` returns a
    factor t < 1 for an indefinite M, so that the result is positive definite. ``mass_as_learned`` replaces this method
    by this function, with t = 1 for every M.
    """
    return mass.new_ones(mass.shape[:-2])


@contextmanager
def mass_as_learned(model: nn.Module) -> Iterator[None]:
    """Context manager in which ``DerivedMass`` does not correct an indefinite mass matrix M of the model.

    Fits that do not invert M use it: with the correction, gradient descent would stop at the boundary of the positive
    definite matrices. Models with other mass matrices are unchanged.
    """
    mass = model.mass if isinstance(model, NetworkDynamics) else None
    if not isinstance(mass, DerivedMass):
        yield
        return
    # The attribute `fraction` of the instance hides the method of `DerivedMass`, so that only this model is changed.
    vars(mass)["fraction"] = unbounded
    try:
        yield
    finally:
        del vars(mass)["fraction"]
