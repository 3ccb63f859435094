"""The equations of motion of an arm, whatever its energies and friction are made of."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from spelgen.runtime.lie_group import from_group, to_group


def solved(matrix: Tensor, right: Tensor) -> Tensor:
    """matrix^-1 right, (..., n)."""
    # its derivative costs one more solution; a Cholesky factor's would cost several times that
    solution: Tensor = torch.linalg.solve(matrix, right.unsqueeze(-1))
    return solution.squeeze(-1)


def applied(matrix: Tensor, vector: Tensor) -> Tensor:
    """matrix vector, (..., n)."""
    if vector.dim() == 1:  # fewer steps, which is what one state costs
        return matrix @ vector
    return (matrix @ vector.unsqueeze(-1)).squeeze(-1)


def combined(weights: Tensor, rows: Tensor) -> Tensor:
    """The sum of weighted rows, weights^T rows, (..., m)."""
    if weights.dim() == 1:
        return weights @ rows
    return (weights.unsqueeze(-2) @ rows).squeeze(-2)


State = tuple[Tensor, Tensor]  # q and p, or how fast they change


class PortHamiltonian(nn.Module):
    """q' = dH/dp and p' = -dH/dq - D dH/dp + G tau, with H = 1/2 p^T M(q)^-1 p + V(q).

    The port-Hamiltonian form (van der Schaft and Jeltsema, Port-Hamiltonian Systems Theory, 2014).
    Where friction remembers, z, (..., n, K), is part of the state and adds its energy to H; without
    it friction is that of a joint that slides the way it moves.
    ``prepared`` is what ``prepare`` gave: all that depends on the weights alone. ``at`` is what
    ``configuration`` gave: all that is computed of q alone. Shapes: q, qd, tau, p are (..., n).
    """

    n: int
    joint_names: tuple[str, ...]
    joint_types: tuple[str, ...]  # "revolute" or "prismatic"
    elements = 0  # K, of friction's memory at a joint

    def prepare(self, definite: bool = True) -> Any:
        """All that depends on the weights alone; holds until they change.

        Without ``definite`` M is left as learned: for the weak form, whose velocities are measured.
        """
        raise NotImplementedError

    def configuration(self, q: Tensor, prepared: Any) -> Any:
        """All that is computed of q alone."""
        raise NotImplementedError

    def mass_at(self, at: Any, prepared: Any) -> tuple[Tensor, Any]:
        """M(q), (..., n, n), and what its derivatives need."""
        raise NotImplementedError

    def energy_at(self, at: Any, prepared: Any) -> Tensor:
        """V(q), (...) [J]."""
        raise NotImplementedError

    def gravity_at(self, at: Any, prepared: Any) -> Tensor:
        """dV/dq, (..., n) [Nm, N]."""
        raise NotImplementedError

    def lagrangian_gradient(self, at: Any, qd: Tensor, residuals: Any, prepared: Any) -> Tensor:
        """d/dq of 1/2 qd^T M(q) qd - V(q), (..., n)."""
        raise NotImplementedError

    def nonlinear_at(self, at: Any, qd: Tensor, residuals: Any, prepared: Any) -> Tensor:
        """The torque that holds qd steady without friction: Coriolis, centrifugal and gravity."""
        raise NotImplementedError

    def friction_at(self, at: Any, qd: Tensor, prepared: Any, z: Tensor | None = None) -> Tensor:
        """The friction torque, (..., n) [Nm, N]: D(q, qd) qd, or that of bristles at z."""
        raise NotImplementedError

    def stored_energy(self, z: Tensor, prepared: Any) -> Tensor:
        """What friction's memory gives back, (...) [J]."""
        raise NotImplementedError

    def memory(self, qd: Tensor) -> Tensor:
        """z, (..., n, K), of joints that have long gone this way."""
        return qd.unsqueeze(-1)[..., :0]

    def memory_rate(self, qd: Tensor, z: Tensor) -> Tensor:
        """z', (..., n, K)."""
        return z

    def memory_after(self, z: Tensor, displacement: Tensor) -> Tensor:
        """z after joints went one way by (..., n), exactly."""
        return z

    def dissipation_at(self, at: Any, qd: Tensor, prepared: Any) -> Tensor:
        """D(q, qd), (..., n, n)."""
        raise NotImplementedError

    def input_at(self, at: Any, prepared: Any) -> Tensor:
        """G, (..., n, n)."""
        raise NotImplementedError

    def input_force(self, at: Any, qd: Tensor, tau: Tensor, prepared: Any) -> Tensor:
        """What the drives do at qd under the input tau: G tau, (..., n) [Nm, N]."""
        raise NotImplementedError

    def input_torque(self, at: Any, qd: Tensor, force: Tensor, prepared: Any) -> Tensor:
        """The tau, (..., n), that makes this force."""
        raise NotImplementedError

    def mass_matrix(self, q: Tensor, prepared: Any = None) -> Tensor:
        """M(q), (..., n, n) [kg m^2, kg m, kg]."""
        prepared = self.prepare() if prepared is None else prepared
        return self.mass_at(self.configuration(q, prepared), prepared)[0]

    def potential_energy(self, q: Tensor) -> Tensor:
        """V(q), (...) [J]."""
        prepared = self.prepare()
        return self.energy_at(self.configuration(q, prepared), prepared)

    def gravity(self, q: Tensor) -> Tensor:
        """dV/dq, (..., n) [Nm, N]."""
        prepared = self.prepare()
        return self.gravity_at(self.configuration(q, prepared), prepared)

    def nonlinear_effects(self, q: Tensor, qd: Tensor) -> Tensor:
        """Coriolis, centrifugal and gravity torque, (..., n) [Nm, N]."""
        prepared = self.prepare()
        at = self.configuration(q, prepared)
        return self.nonlinear_at(at, qd, self.mass_at(at, prepared)[1], prepared)

    def friction_torque(self, q: Tensor, qd: Tensor, z: Tensor | None = None) -> Tensor:
        """D(q, qd) qd, or the torque of bristles at z, (..., n) [Nm, N]."""
        prepared = self.prepare()
        return self.friction_at(self.configuration(q, prepared), qd, prepared, z)

    def dissipation(self, q: Tensor, qd: Tensor) -> Tensor:
        """D(q, qd), (..., n, n) [Nm s/rad, N s/m]."""
        prepared = self.prepare()
        return self.dissipation_at(self.configuration(q, prepared), qd, prepared)

    def input_matrix(self, q: Tensor) -> Tensor:
        """G(q), (..., n, n)."""
        prepared = self.prepare()
        return self.input_at(self.configuration(q, prepared), prepared)

    def momentum(self, q: Tensor, qd: Tensor, prepared: Any = None) -> Tensor:
        """p = M(q) qd, (..., n)."""
        return applied(self.mass_matrix(q, prepared), qd)

    def velocity(self, q: Tensor, p: Tensor, prepared: Any = None) -> Tensor:
        """qd = M(q)^-1 p, (..., n)."""
        return solved(self.mass_matrix(q, prepared), p)

    def hamiltonian(self, q: Tensor, p: Tensor, z: Tensor | None = None) -> Tensor:
        """H, (...) [J]."""
        prepared = self.prepare()
        at = self.configuration(q, prepared)
        qd = solved(self.mass_at(at, prepared)[0], p)
        energy = 0.5 * (p * qd).sum(dim=-1) + self.energy_at(at, prepared)
        return energy if z is None else energy + self.stored_energy(z, prepared)

    def forward_dynamics(self, q: Tensor, qd: Tensor, tau: Tensor, z: Tensor | None = None) -> Tensor:
        """qdd, (..., n), under the input tau."""
        prepared = self.prepare()
        at = self.configuration(q, prepared)
        mass, residuals = self.mass_at(at, prepared)
        force = self.input_force(at, qd, tau, prepared)
        force = force - self.nonlinear_at(at, qd, residuals, prepared)
        return solved(mass, force - self.friction_at(at, qd, prepared, z))

    def inverse_dynamics(self, q: Tensor, qd: Tensor, qdd: Tensor, z: Tensor | None = None) -> Tensor:
        """The torque, (..., n), that gives qdd."""
        prepared = self.prepare()
        at = self.configuration(q, prepared)
        mass, residuals = self.mass_at(at, prepared)
        force = applied(mass, qdd) + self.nonlinear_at(at, qd, residuals, prepared)
        return self.input_torque(at, qd, force + self.friction_at(at, qd, prepared, z), prepared)

    def port_hamiltonian_rhs(
        self, q: Tensor, p: Tensor, tau: Tensor | None, prepared: Any, z: Tensor | None = None
    ) -> State:
        """q' and p', (..., n), under the input tau; without one, of the arm left to itself."""
        at = self.configuration(q, prepared)
        mass, residuals = self.mass_at(at, prepared)
        qd = solved(mass, p)
        force = self.lagrangian_gradient(at, qd, residuals, prepared)
        force = force - self.friction_at(at, qd, prepared, z)
        return qd, force if tau is None else force + self.input_force(at, qd, tau, prepared)

    def forward(self, t: Tensor, state: Tensor) -> Tensor:
        """The rate of (q, p, z), (..., 2 n + n K), or of (q, p, z, tau), where tau is held.

        A state that is too short for z has none: friction is then that of joints which slide.
        """
        n = self.n
        elements = self.elements if state.shape[-1] >= (2 + self.elements) * n else 0
        q, p, flat, tau = state.tensor_split((n, 2 * n, (2 + elements) * n), dim=-1)
        z = flat.reshape(*flat.shape[:-1], n, elements) if elements else None
        qd, force = self.port_hamiltonian_rhs(q, p, tau if tau.shape[-1] else None, self.prepare(), z)
        moved = flat if z is None else self.memory_rate(qd, z).flatten(-2)
        return torch.cat([qd, force, moved, torch.zeros_like(tau)], dim=-1)

    def to_group(self, q: Tensor) -> list[Tensor]:
        """By joint, R in SO(3), (..., 3, 3), or r in R^3, (..., 3), if prismatic; z is its axis."""
        return to_group(q, self.joint_types)

    def from_group(self, parts: list[Tensor]) -> Tensor:
        """q, (..., n), with angles in [-pi, pi]; the inverse of ``to_group``."""
        return from_group(parts, self.joint_types)
