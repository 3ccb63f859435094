"""The equations of motion of an arm, whatever its energies and friction are made of."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn

from spelgen.runtime.joints import Joints, vector
from spelgen.runtime.parts import MassResiduals, Pose, Prepared


def solved(matrix: Tensor, right: Tensor) -> Tensor:
    """Return matrix^-1 right, (..., n)."""
    # its derivative costs one more solution; a Cholesky factor's would cost several times that
    solution: Tensor = torch.linalg.solve(matrix, right.unsqueeze(-1))
    return solution.squeeze(-1)


def applied(matrix: Tensor, vector: Tensor) -> Tensor:
    """Return matrix vector, (..., n)."""
    if vector.dim() == 1:  # fewer steps, which is what one state costs
        return matrix @ vector
    return (matrix @ vector.unsqueeze(-1)).squeeze(-1)


def combined(weights: Tensor, rows: Tensor) -> Tensor:
    """Return the sum of weighted rows, weights^T rows, (..., m)."""
    if weights.dim() == 1:
        return weights @ rows
    return (weights.unsqueeze(-2) @ rows).squeeze(-2)


class PortHamiltonian(nn.Module):
    """q' = dH/dp and p' = -dH/dq - D dH/dp + G tau, with H = 1/2 p^T M(q)^-1 p + V(q).

    The port-Hamiltonian form (van der Schaft and Jeltsema, Port-Hamiltonian Systems Theory, 2014).
    Shapes: q, qd, qdd, tau and p are (..., n). ``prepared`` is what ``prepare`` gave: all that
    depends on the weights alone. ``pose`` is what ``configuration`` gave: all that depends on q alone.
    """

    n: int
    joint_names: tuple[str, ...]
    joint_types: tuple[str, ...]  # "revolute" or "prismatic"
    elements = 0  # K, the numbers of friction's state at a joint
    # networks and rigid bodies have these each of their own
    prepare: Callable[..., Prepared]
    configuration: Callable[[Tensor, Prepared], Pose]  # of q
    mass_at: Callable[[Pose, Prepared], tuple[Tensor, MassResiduals]]  # M, and what its derivatives need
    energy_at: Callable[[Pose, Prepared], Tensor]  # V, (...) [J]
    gravity_at: Callable[[Pose, Prepared], Tensor]  # dV/dq
    # d/dq of 1/2 qd^T M qd - V; then the Coriolis, centrifugal and gravity torque
    lagrangian_gradient: Callable[[Pose, Tensor, MassResiduals, Prepared], Tensor]
    nonlinear_at: Callable[[Pose, Tensor, MassResiduals, Prepared], Tensor]
    friction_at: Callable[..., Tensor]  # D(q, qd) qd
    dissipation_at: Callable[[Pose, Tensor, Prepared], Tensor]  # D, (..., n, n)

    def __init__(self, joints: Joints) -> None:
        super().__init__()
        # 1 where a joint is driven, 0 where it is passive
        self.actuated = nn.Buffer(vector(float(x) for x in joints.actuated))

    def at(self, q: Tensor, prepared: Prepared | None = None) -> tuple[Pose, Prepared]:
        """Return the pose at q, and what depends on the weights alone."""
        prepared = self.prepare() if prepared is None else prepared
        return self.configuration(q, prepared), prepared

    def mass_matrix(self, q: Tensor, prepared: Prepared | None = None) -> Tensor:
        """Return M(q), (..., n, n) [kg m^2, kg m, kg]."""
        return self.mass_at(*self.at(q, prepared))[0]

    def potential_energy(self, q: Tensor) -> Tensor:
        """Return V(q), (...) [J]."""
        return self.energy_at(*self.at(q))

    def gravity(self, q: Tensor) -> Tensor:
        """Return dV/dq, (..., n) [Nm, N]."""
        return self.gravity_at(*self.at(q))

    def nonlinear_effects(self, q: Tensor, qd: Tensor) -> Tensor:
        """Return the Coriolis, centrifugal and gravity torque, (..., n) [Nm, N]."""
        pose, prepared = self.at(q)
        return self.nonlinear_at(pose, qd, self.mass_at(pose, prepared)[1], prepared)

    def friction_torque(self, q: Tensor, qd: Tensor, *state: Tensor | None) -> Tensor:
        """Return D(q, qd) qd, (..., n) [Nm, N]."""
        pose, prepared = self.at(q)
        return self.friction_at(pose, qd, prepared, *state)

    def dissipation(self, q: Tensor, qd: Tensor) -> Tensor:
        """Return D(q, qd), (..., n, n) [Nm s/rad, N s/m]."""
        pose, prepared = self.at(q)
        return self.dissipation_at(pose, qd, prepared)

    def input_matrix(self, q: Tensor) -> Tensor:
        """Return G(q), (..., n, n): an input is the torque of its own joint, none of a passive one."""
        return torch.diag(self.actuated).expand(*q.shape, -1)

    def input_force(self, pose: Pose, qd: Tensor, tau: Tensor, prepared: Prepared) -> Tensor:
        """Return G tau, (..., n) [Nm, N]."""
        return self.actuated * tau

    def input_torque(self, pose: Pose, qd: Tensor, force: Tensor, prepared: Prepared) -> Tensor:
        """Return the tau, (..., n), that makes this force; a passive joint shows the torque it lacks."""
        return force

    def momentum(self, q: Tensor, qd: Tensor, prepared: Prepared | None = None) -> Tensor:
        """Return p = M(q) qd, (..., n)."""
        return applied(self.mass_matrix(q, prepared), qd)

    def velocity(self, q: Tensor, p: Tensor, prepared: Prepared | None = None) -> Tensor:
        """Return qd = M(q)^-1 p, (..., n)."""
        return solved(self.mass_matrix(q, prepared), p)

    def hamiltonian(self, q: Tensor, p: Tensor) -> Tensor:
        """Return H, (...) [J]."""
        return 0.5 * (p * self.velocity(q, p)).sum(dim=-1) + self.potential_energy(q)

    def forward_dynamics(self, q: Tensor, qd: Tensor, tau: Tensor, *state: Tensor | None) -> Tensor:
        """Return qdd, (..., n), under the input tau."""
        pose, prepared = self.at(q)
        mass, residuals = self.mass_at(pose, prepared)
        force = self.input_force(pose, qd, tau, prepared) - self.nonlinear_at(pose, qd, residuals, prepared)
        return solved(mass, force - self.friction_at(pose, qd, prepared, *state))

    def inverse_dynamics(self, q: Tensor, qd: Tensor, qdd: Tensor, *state: Tensor | None) -> Tensor:
        """Return the input tau, (..., n), that gives qdd."""
        pose, prepared = self.at(q)
        mass, residuals = self.mass_at(pose, prepared)
        force = applied(mass, qdd) + self.nonlinear_at(pose, qd, residuals, prepared)
        return self.input_torque(pose, qd, force + self.friction_at(pose, qd, prepared, *state), prepared)

    def port_hamiltonian_rhs(
        self, q: Tensor, p: Tensor, tau: Tensor | None, prepared: Prepared, *state: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """Return q' and p', (..., n), under the input tau; without one, of the arm left to itself."""
        pose = self.configuration(q, prepared)
        mass, residuals = self.mass_at(pose, prepared)
        qd = solved(mass, p)
        force = self.lagrangian_gradient(pose, qd, residuals, prepared)
        force = force - self.friction_at(pose, qd, prepared, *state)
        return qd, force if tau is None else force + self.input_force(pose, qd, tau, prepared)

    def forward(self, t: Tensor, state: Tensor) -> Tensor:
        """Return the rate of (q, p), (..., 2 n), or of (q, p, tau), where tau is held."""
        q, p, tau = state.tensor_split((self.n, 2 * self.n), dim=-1)
        qd, force = self.port_hamiltonian_rhs(q, p, tau if tau.shape[-1] else None, self.prepare())
        return torch.cat([qd, force, torch.zeros_like(tau)], dim=-1)

    def to_group(self, q: Tensor) -> list[Tensor]:
        """Return, by joint, R in SO(3), (..., 3, 3), or r in R^3, (..., 3), if prismatic; z is its axis."""
        zero, one = torch.zeros_like(q), torch.ones_like(q)
        rows = [q.cos(), -q.sin(), zero, q.sin(), q.cos(), zero, zero, zero, one]
        rotations = torch.stack(rows, dim=-1).reshape(*q.shape, 3, 3).unbind(dim=-3)
        positions = torch.stack([zero, zero, q], dim=-1).unbind(dim=-2)
        pairs = zip(self.joint_types, rotations, positions, strict=True)
        return [rotation if kind == "revolute" else position for kind, rotation, position in pairs]

    def from_group(self, elements: list[Tensor]) -> Tensor:
        """Return q, (..., n), with angles in [-pi, pi]; the inverse of ``to_group``."""
        values = []
        for kind, element in zip(self.joint_types, elements, strict=True):
            if kind == "revolute":
                values.append(torch.atan2(element[..., 1, 0], element[..., 0, 0]))
            else:
                values.append(element[..., 2])
        return torch.stack(values, dim=-1)
