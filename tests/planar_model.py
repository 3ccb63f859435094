"""A hand-written model of a planar two-joint arm with the interface of an emitted module."""

from typing import NamedTuple

import torch
from torch import nn

FACTS = """{
  "format": 8,
  "robot": "stand_in",
  "urdf": "stand_in.urdf",
  "urdf_sha256": "none",
  "spec_sha256": "none",
  "options": {},
  "joints": {"shoulder": "revolute", "elbow": "revolute"}
}"""


class Pose(NamedTuple):
    """The configuration cache: q and M."""

    q: torch.Tensor
    mass: torch.Tensor


class Model(nn.Module):
    """M = [[a + 2 b cos q2, d + b cos q2], [d + b cos q2, d]], two hanging weights, viscous friction."""

    joint_names = ("shoulder", "elbow")
    joint_types = ("revolute", "revolute")
    n = 2

    def __init__(self, seed: int = 0) -> None:
        super().__init__()
        generator = torch.Generator().manual_seed(seed)
        start = 0.01 * torch.randn(5, generator=generator, dtype=torch.float64)
        self.inertia = nn.Parameter(
            torch.tensor([0.5, 0.0, 0.0], dtype=torch.float64) + start[:3]
        )  # b, log d, log e
        self.weight = nn.Parameter(torch.zeros(2, dtype=torch.float64) + start[3:])
        self.damping = nn.Parameter(torch.full((2,), -2.0, dtype=torch.float64))

    def _coefficients(self):
        b, d = self.inertia[0], self.inertia[1].exp()
        return d + b**2 / d + self.inertia[2].exp(), b, d

    def _entries(self, q):
        a, b, d = self._coefficients()
        bc = b * q[..., 1].cos()
        return a + 2 * bc, d + bc, d

    def mass_matrix(self, q):
        m11, m12, m22 = self._entries(q)
        return torch.stack([m11, m12, m12, m22.expand(m12.shape)], -1).unflatten(-1, (2, 2))

    def potential_energy(self, q):
        return -(self.weight * q.cumsum(-1).cos()).sum(-1)

    def gravity(self, q):
        torque = self.weight * q.cumsum(-1).sin()
        return torque.flip(-1).cumsum(-1).flip(-1)

    def dissipation(self, q, qd):
        return torch.diag_embed(self.damping.exp().expand(q.shape))

    def input_matrix(self, q):
        return torch.eye(2, dtype=q.dtype).expand(*q.shape, 2)

    def at(self, q, prepared=None):
        return q

    def momentum(self, q, qd):
        return (self.mass_matrix(q) @ qd.unsqueeze(-1)).squeeze(-1)

    def velocity(self, q, p):
        (m11, m12, m22), (p1, p2) = self._entries(q), p.unbind(-1)
        scaled = torch.stack([m22 * p1 - m12 * p2, m11 * p2 - m12 * p1], -1)
        return scaled / (m11 * m22 - m12**2).unsqueeze(-1)

    def hamiltonian(self, q, p, z=None):
        return 0.5 * (p * self.velocity(q, p)).sum(-1) + self.potential_energy(q)

    def _kinetic_slope(self, q, qd):
        """d(1/2 qd^T M qd)/dq (..., 2): only c2 varies."""
        first, second = qd.unbind(-1)
        slope = -self.inertia[0] * q[..., 1].sin() * first * (first + second)
        return torch.stack([torch.zeros_like(slope), slope], -1)

    def _mass_rate(self, q, qd):
        rate = -self.inertia[0] * q[..., 1].sin() * qd[..., 1]
        return torch.stack([2 * rate, rate, rate, torch.zeros_like(rate)], -1).unflatten(-1, (2, 2))

    def nonlinear_effects(self, q, qd):
        q = q.q if isinstance(q, Pose) else q
        coriolis = (self._mass_rate(q, qd) @ qd.unsqueeze(-1)).squeeze(-1) - self._kinetic_slope(q, qd)
        return coriolis + self.gravity(q)

    def friction_torque(self, q, qd, z=None):
        return self.damping.exp() * qd

    def inverse_dynamics(self, q, qd, qdd, z=None):
        return self.momentum(q, qdd) + self.nonlinear_effects(q, qd) + self.friction_torque(q, qd)

    def forward_dynamics(self, q, qd, tau, z=None):
        return self.velocity(q, tau - self.inverse_dynamics(q, qd, torch.zeros_like(qd)))

    def prepare(self):
        return None

    @property
    def dynamics(self):
        """The part that an emitted model keeps separately; here it is the model itself."""
        return self

    def configuration(self, q, prepared):
        return Pose(q, self.mass_matrix(q))

    def lagrangian_gradient(self, pose, qd):
        return self._kinetic_slope(pose.q, qd) - self.gravity(pose.q)

    def input_force(self, pose, qd, tau):
        return tau

    def port_hamiltonian_rhs(self, q, p, tau, prepared, z=None):
        qd = self.velocity(q, p)
        pd = self._kinetic_slope(q, qd) - self.gravity(q) - self.friction_torque(q, qd)
        return qd, pd if tau is None else pd + tau

    def forward(self, t, state):
        q, p, *inputs = state.split(2, dim=-1)
        rates = self.port_hamiltonian_rhs(q, p, inputs[0] if inputs else None, None)
        return torch.cat([*rates, *map(torch.zeros_like, inputs)], -1)
