"""The equations of motion of an arm, whatever its energies and friction are made of."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn

from spelgen.runtime.parts import Pose, Prepared


def applied(matrix: Tensor, vector: Tensor) -> Tensor:
    """Return matrix vector, (..., n)."""
    if vector.dim() == 1:  # fewer steps, which is what one state costs
        return matrix @ vector
    return (matrix @ vector.unsqueeze(-1)).squeeze(-1)


class PortHamiltonian(nn.Module):
    """q' = dH/dp and p' = -dH/dq - D dH/dp + G tau, with H = 1/2 p^T M(q)^-1 p + V(q).

    The port-Hamiltonian form (van der Schaft and Jeltsema, Port-Hamiltonian Systems Theory, 2014).
    q, qd, qdd, tau and p are (..., n), with any leading dimensions; rad and Nm, m and N if prismatic. In
    place of q methods take a pose, too: all that depends on q, which ``at`` works out once for several.
    """

    n: int
    prepare: Callable[..., Prepared]  # networks and rigid bodies have each their own of these
    configuration: Callable[[Tensor, Prepared], Pose]
    potential_energy: Callable[..., Tensor]  # V, (...) [J]
    gravity: Callable[[Tensor | Pose], Tensor]  # dV/dq, (..., n) [Nm, N]
    lagrangian_gradient: Callable[[Tensor | Pose, Tensor], Tensor]  # d/dq of 1/2 qd^T M qd - V
    nonlinear_effects: Callable[[Tensor | Pose, Tensor], Tensor]  # Coriolis, centrifugal, gravity torque
    friction_torque: Callable[..., Tensor]  # D(q, qd) qd

    def at(self, q: Tensor | Pose, *others: Tensor, prepared: Prepared | None = None) -> Pose:
        """Return the pose at q. Raises TypeError or ValueError for vectors not as q and the weights."""
        if isinstance(q, tuple):
            return q  # a pose already: what stands beside it is not checked
        dtype = self.get_buffer("friction.nominal").dtype
        for x in (q, *others):
            kind = x.dtype if isinstance(x, Tensor) else type(x).__name__
            if kind != dtype:
                raise TypeError(f"got {kind}, expected a {dtype} tensor: torch.as_tensor(x, dtype={dtype})")
            if x.shape != (*q.shape[:-1], self.n):
                shapes = " and ".join(str(tuple(each.shape)) for each in (q, *others))
                raise ValueError(f"got shapes {shapes}, expected (..., {self.n}) of all alike, joints last")
        return self.configuration(q, self.prepare() if prepared is None else prepared)

    def mass_matrix(self, q: Tensor | Pose) -> Tensor:
        """Return M(q), (..., n, n) [kg m^2, kg m, kg]."""
        mass: Tensor = self.at(q).mass
        return mass

    def input_matrix(self, q: Tensor) -> Tensor:
        """Return G(q), (..., n, n): an input is the torque of its own joint."""
        return torch.eye(self.n).to(q).expand(*q.shape, -1)

    def input_force(self, pose: Pose, qd: Tensor, tau: Tensor) -> Tensor:
        """Return G tau, (..., n) [Nm, N]."""
        return tau

    def input_torque(self, pose: Pose, force: Tensor) -> Tensor:
        """Return the tau, (..., n), that G makes this force of."""
        return force

    def momentum(self, q: Tensor | Pose, qd: Tensor) -> Tensor:
        """Return p = M(q) qd, (..., n)."""
        return applied(self.at(q, qd).mass, qd)

    def velocity(self, q: Tensor | Pose, p: Tensor) -> Tensor:
        """Return qd = M(q)^-1 p, (..., n)."""
        # a derivative of this costs one more solution; a Cholesky factor's would cost several times that
        qd: Tensor = torch.linalg.solve(self.at(q, p).mass, p.unsqueeze(-1))
        return qd.squeeze(-1)

    def hamiltonian(self, q: Tensor | Pose, p: Tensor, *state: Tensor) -> Tensor:
        """Return H, (...) [J]."""
        pose = self.at(q, p)
        return 0.5 * (p * self.velocity(pose, p)).sum(dim=-1) + self.potential_energy(pose, *state)

    def forward_dynamics(self, q: Tensor | Pose, qd: Tensor, tau: Tensor, *state: Tensor | None) -> Tensor:
        """Return qdd, (..., n), under the input tau."""
        pose = self.at(q, qd, tau)
        force = self.input_force(pose, qd, tau) - self.nonlinear_effects(pose, qd)
        force = force - self.friction_torque(pose, qd, *state)
        return self.velocity(pose, force)  # M^-1 times the force

    def inverse_dynamics(self, q: Tensor | Pose, qd: Tensor, qdd: Tensor, *state: Tensor | None) -> Tensor:
        """Return the input tau, (..., n), that gives qdd."""
        pose = self.at(q, qd, qdd)
        force = applied(pose.mass, qdd) + self.nonlinear_effects(pose, qd)
        force = force + self.friction_torque(pose, qd, *state)
        return self.input_torque(pose, force - self.input_force(pose, qd, 0 * qd))

    def port_hamiltonian_rhs(
        self, q: Tensor, p: Tensor, tau: Tensor | None, prepared: Prepared, *state: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """Return q' and p', (..., n), under the input tau; without one, of the arm left to itself."""
        pose = self.at(q, p, p if tau is None else tau, prepared=prepared)
        qd = self.velocity(pose, p)
        force = self.lagrangian_gradient(pose, qd) - self.friction_torque(pose, qd, *state)
        return qd, force if tau is None else force + self.input_force(pose, qd, tau)
