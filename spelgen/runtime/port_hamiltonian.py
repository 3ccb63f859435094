"""The equations of motion of an arm in port-Hamiltonian form, for any model of energy and friction."""

from collections.abc import Callable, Sequence
from typing import Literal

import torch
from torch import Tensor, nn

from spelgen.runtime.motors import MotorInputs
from spelgen.runtime.parts import Configuration, Parameters, Position, applied
from spelgen.runtime.rows import Joint


class PortHamiltonian(nn.Module):
    """Base class of models: q' = dH/dp, p' = -dH/dq - D dH/dp + G tau, with H = 1/2 p^T M(q)^-1 p + V(q).

    This is the port-Hamiltonian form (van der Schaft and Jeltsema, Port-Hamiltonian Systems Theory, 2014),
    with momenta p, mass matrix M(q), potential V(q), dissipation matrix D(q, qd) and input matrix G. Derived
    classes define M, V and friction; this class has the equations of motion.

    Positions q, velocities qd, accelerations qdd, inputs tau and momenta p are (..., n), with any leading
    dimensions, in rad and Nm for revolute joints, in m and N for prismatic joints. If friction has a
    state z, it has the deflections of K bristles per joint, (..., n, K) [rad, m]. In place of q, methods also
    accept the configuration cache that ``at`` returns: all quantities that depend on q only, computed once
    for several calls.

    Args:
        joints: joints of the arm, in the order of q.
        inputs: input matrix G; None: each input drives its own joint.
    """

    prepare: Callable[..., Parameters]
    configuration: Callable[[Tensor, Parameters], Configuration]
    potential_energy: Callable[..., Tensor]  # V(q), (...) [J]
    gravity: Callable[[Position], Tensor]  # dV/dq, (..., n) [Nm, N]
    lagrangian_gradient: Callable[[Position, Tensor], Tensor]  # d/dq of 1/2 qd^T M qd - V, (..., n)
    nonlinear_effects: Callable[[Position, Tensor], Tensor]  # Coriolis, centrifugal and gravity torque
    friction_torque: Callable[..., Tensor]  # D(q, qd) qd, or friction with the friction state z, (..., n)
    memory_rate: Callable[[Tensor, Tensor], Tensor]  # dz/dt, (..., n, K), from the friction state z and qd
    elements = 0  # number of bristles per joint, K

    def __init__(self, joints: Sequence[Joint], inputs: MotorInputs | None = None) -> None:
        super().__init__()
        self.joints, self.n = tuple(joints), len(joints)
        self.inputs = inputs

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the joints, in the order of q, qd and tau."""
        return tuple(joint.name for joint in self.joints)

    @property
    def joint_types(self) -> tuple[str, ...]:
        """Type of each joint: ``revolute`` or ``prismatic``."""
        return tuple(joint.joint_type for joint in self.joints)

    @property
    def input_quantity(self) -> Literal["torque", "position"]:
        """Quantity of the inputs: ``torque``, or ``position`` for commands of position servos."""
        return "torque"

    def at(self, q: Position, *others: Tensor, prepared: Parameters = None) -> Configuration:
        """Return the configuration cache at q. Raises TypeError or ValueError for a wrong dtype or shape.

        Args:
            q: positions, (..., n), or a configuration cache, which is returned unchanged.
            others: further vectors, such as qd and tau, (..., n), of which only dtype and shape are
                checked.
            prepared: parameter cache that ``prepare`` returned; None: the method calls ``prepare``.
        """
        # A tuple is a configuration cache. It needs no check: the call that created it has checked q.
        if isinstance(q, tuple):
            return q
        dtype = self.get_buffer("friction.nominal").dtype
        for x in (q, *others):
            kind = x.dtype if isinstance(x, Tensor) else type(x).__name__
            if kind != dtype:
                raise TypeError(f"got {kind}, expected a {dtype} tensor: torch.as_tensor(x, dtype={dtype})")
            if x.shape != (*q.shape[:-1], self.n):
                shapes = " and ".join(str(tuple(each.shape)) for each in (q, *others))
                raise ValueError(f"got shapes {shapes}, expected the same shape (..., {self.n}), joints last")
        return self.configuration(q, self.prepare() if prepared is None else prepared)

    def mass_matrix(self, q: Position) -> Tensor:
        """Return the mass matrix M(q), (..., n, n) [kg m^2, kg m, kg]."""
        mass: Tensor = self.at(q).mass
        return mass

    def input_matrix(self, q: Tensor) -> Tensor:
        """Return the input matrix G(q), (..., n, n): joint torque per input."""
        matrix = torch.eye(self.n).to(q) if self.inputs is None else self.inputs.gains()
        return matrix.expand(*q.shape, -1)

    def input_force(self, cache: Configuration, qd: Tensor, tau: Tensor) -> Tensor:
        """Return the joint torques of the inputs tau: G tau, (..., n) [Nm, N].

        cache: configuration cache at q. Derived classes may add terms, such as torque offsets.
        """
        return tau if self.inputs is None else self.inputs.force(tau)

    def input_torque(self, cache: Configuration, force: Tensor) -> Tensor:
        """Return the inputs tau, (..., n), that solve G tau = force, for joint torques force, (..., n).

        cache: configuration cache at q.
        """
        return force if self.inputs is None else self.inputs.torque(force)

    def momentum(self, q: Position, qd: Tensor) -> Tensor:
        """Return the momentum p = M(q) qd, (..., n)."""
        return applied(self.at(q, qd).mass, qd)

    def velocity(self, q: Position, p: Tensor) -> Tensor:
        """Return the velocity qd = M(q)^-1 p, (..., n) [rad/s, m/s], at the momentum p, (..., n)."""
        # `torch.linalg.solve` does not use that M is positive definite. A Cholesky factorisation is not used,
        # because its derivative takes several times as long as the derivative of `solve`.
        qd: Tensor = torch.linalg.solve(self.at(q, p).mass, p.unsqueeze(-1))
        return qd.squeeze(-1)

    def hamiltonian(self, q: Position, p: Tensor, *state: Tensor) -> Tensor:
        """Return the total energy H = 1/2 p^T M(q)^-1 p + V(q), (...) [J].

        p: momenta, (..., n). state: friction state z, (..., n, K) [rad, m], whose elastic energy is added to
        H; without it, the bristles have no energy.
        """
        cache = self.at(q, p)
        # The kinetic energy 1/2 p^T M^-1 p is 1/2 p^T qd.
        return 0.5 * (p * self.velocity(cache, p)).sum(dim=-1) + self.potential_energy(cache, *state)

    def forward_dynamics(self, q: Position, qd: Tensor, tau: Tensor, *state: Tensor | None) -> Tensor:
        """Return the accelerations qdd, (..., n) [rad/s^2, m/s^2], under the inputs tau, (..., n).

        state: friction state z, (..., n, K) [rad, m]; without it, friction depends on velocity only.
        """
        cache = self.at(q, qd, tau)
        force = self.input_force(cache, qd, tau) - self.nonlinear_effects(cache, qd)
        force = force - self.friction_torque(cache, qd, *state)
        # `velocity` returns M^-1 p for a momentum p; for a force it returns the acceleration M^-1 force.
        return self.velocity(cache, force)

    def inverse_dynamics(self, q: Position, qd: Tensor, qdd: Tensor, *state: Tensor | None) -> Tensor:
        """Return the inputs tau, (..., n), that give the accelerations qdd, (..., n) [rad/s^2, m/s^2].

        state: friction state z, (..., n, K) [rad, m]; without it, friction depends on velocity only.
        """
        cache = self.at(q, qd, qdd)
        force = applied(cache.mass, qdd) + self.nonlinear_effects(cache, qd)
        force = force + self.friction_torque(cache, qd, *state)
        # ``input_force`` may be nonzero at tau = 0, for example due to a torque offset of the sensors. Its
        # value at tau = 0 is subtracted from the force, so that G tau = force can be solved for tau.
        return self.input_torque(cache, force - self.input_force(cache, qd, 0 * qd))

    def port_hamiltonian_rhs(
        self, q: Tensor, p: Tensor, tau: Tensor | None, prepared: Parameters, *state: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """Return the time derivatives q' and p' of positions and momenta, (..., n) each.

        Args:
            q: positions, (..., n) [rad, m].
            p: momenta, (..., n).
            tau: inputs, (..., n); None: no input.
            prepared: parameter cache that ``prepare`` returned.
            state: friction state z, (..., n, K) [rad, m]; without it, friction depends on velocity only.
        """
        cache = self.at(q, p, p if tau is None else tau, prepared=prepared)
        qd = self.velocity(cache, p)
        force = self.lagrangian_gradient(cache, qd) - self.friction_torque(cache, qd, *state)
        return qd, force if tau is None else force + self.input_force(cache, qd, tau)

    def forward(self, t: Tensor, state: Tensor) -> Tensor:
        """Return the time derivative of the state vector, with the shape of ``state``, for ODE solvers.

        Args:
            t: time [s], which has no effect: the equations are autonomous.
            state: (q, p, z), (..., 2 n + n K): positions, momenta, and friction state z of K bristles per
                joint; or (q, p), (..., 2 n), with friction that depends on velocity only. Constant inputs
                tau, (..., n), may be appended to (q, p, z); their time derivatives are zero.
        """
        n, size = self.n, self.n * self.elements
        if state.shape[-1] < 2 * n + size:
            size = 0
        # ODE solvers integrate one vector: a constant input is appended to the state, and its time derivative
        # is zero.
        q, p, flat, tau = state.tensor_split((n, 2 * n, 2 * n + size), dim=-1)
        z = [flat.reshape(*flat.shape[:-1], n, -1)] if size else []
        qd, force = self.port_hamiltonian_rhs(q, p, tau if tau.shape[-1] else None, self.prepare(), *z)
        rates = [self.memory_rate(x, qd).flatten(-2) for x in z]
        return torch.cat([qd, force, *rates, torch.zeros_like(tau)], dim=-1)
