"""A port-Hamiltonian model whose functions of q are networks, and friction from networks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from spelgen.runtime.networks import JointEncoding, MaskedNetwork
from spelgen.runtime.parts import Inputs, Intermediates, Layers, Mass, Parameters
from spelgen.runtime.port_hamiltonian import PortHamiltonian, applied
from spelgen.runtime.rows import Joint, vector


class NetworkConfiguration(NamedTuple):
    """All that depends on q only."""

    encoded: Tensor  # input of the networks, see ``JointEncoding``
    mass: Tensor  # M(q), (..., n, n)
    intermediates: Intermediates  # intermediates of the derivatives of M
    parameters: dict[str, Parameters]


class NetworkDynamics(PortHamiltonian):
    """M, V and D are networks; the network of V is in units of ``potential_scale`` [J]."""

    def __init__(
        self,
        *,
        joints: Sequence[Joint],
        mass: Mass,
        potential: MaskedNetwork,
        potential_scale: float,
        friction: NetworkFriction,
        inputs: Inputs | None = None,
    ) -> None:
        super().__init__(joints, inputs)
        self.encoding, self.mass = JointEncoding(joints), mass
        self.potential, self.friction = potential, friction
        self.scale = nn.Buffer(torch.full((1, 1), potential_scale, dtype=torch.float64))

    def prepare(self) -> dict[str, Parameters]:
        """Return the parameter caches of mass matrix, potential and friction."""
        # No offset: a constant of V has no effect on the motion. The product keeps dtype and device.
        potential = self.potential.prepare(self.scale, 0 * self.scale[0])
        return {"mass": self.mass.prepare(), "potential": potential, "friction": self.friction.prepare()}

    def configuration(self, q: Tensor, parameters: dict[str, Parameters]) -> NetworkConfiguration:
        """Return all that depends on q, (..., n), only."""
        encoded = self.encoding.forward(q)
        mass, intermediates = self.mass.forward(encoded, parameters["mass"])
        return NetworkConfiguration(encoded, mass, intermediates, parameters)

    def potential_energy(self, q: Tensor | NetworkConfiguration) -> Tensor:
        """Return V(q), (...) [J]."""
        cache: NetworkConfiguration = self.at(q)
        return self.potential.forward(cache.encoded, cache.parameters["potential"])[0].squeeze(-1)

    def gravity(self, q: Tensor | NetworkConfiguration) -> Tensor:
        """Return dV/dq, (..., n) [Nm, N]."""
        cache: NetworkConfiguration = self.at(q)
        # At rest the gradient of the kinetic energy is zero.
        return -self.lagrangian_gradient(cache, torch.zeros_like(cache.mass[..., 0]))

    def lagrangian_gradient(self, q: Tensor | NetworkConfiguration, qd: Tensor) -> Tensor:
        """Return d/dq of 1/2 qd^T M(q) qd - V(q), (..., n)."""
        cache: NetworkConfiguration = self.at(q, qd)
        intermediates = self.potential.forward(cache.encoded, cache.parameters["potential"])[1]
        # One reverse sweep per network, with 1/2 qd qd^T as the cotangent of M, then the chain rule of the
        # encoding.
        kinetic = self.mass.kinetic_vjp(qd, cache.intermediates)
        return self.encoding.vjp(cache.encoded, kinetic - self.potential.vjp(intermediates, qd.new_ones(1)))

    def nonlinear_effects(self, q: Tensor | NetworkConfiguration, qd: Tensor) -> Tensor:
        """Return dM/dt qd - d/dq (1/2 qd^T M qd) + dV/dq, (..., n)."""
        cache: NetworkConfiguration = self.at(q, qd)
        # dM/dt is one directional derivative: the n^3 Christoffel symbols are not needed.
        mass_rate = self.mass.jvp(self.encoding.jvp(cache.encoded, qd), cache.intermediates)
        return applied(mass_rate, qd) - self.lagrangian_gradient(cache, qd)

    def friction_torque(self, q: Tensor | NetworkConfiguration, qd: Tensor) -> Tensor:
        """Return D(q, qd) qd, (..., n) [Nm, N]."""
        cache: NetworkConfiguration = self.at(q, qd)
        layers = cache.parameters["friction"]
        return self.friction.forward(cache.encoded, qd, layers, qd.unsqueeze(-1)).squeeze(-1)

    def dissipation(self, q: Tensor | NetworkConfiguration, qd: Tensor) -> Tensor:
        """Return D(q, qd), (..., n, n) [Nm s/rad, N s/m]."""
        cache: NetworkConfiguration = self.at(q, qd)
        return self.friction.forward(
            cache.encoded, qd, cache.parameters["friction"], torch.eye(self.n).to(qd)
        )

    def forward(self, t: Tensor, state: Tensor) -> Tensor:
        """Return the rate of (q, p), (..., 2 n), or of (q, p, tau) with a constant tau, (..., 3 n)."""
        # ODE solvers integrate one vector; a constant input is a part of it with the rate zero.
        q, p, tau = state.tensor_split((self.n, 2 * self.n), dim=-1)
        qd, force = self.port_hamiltonian_rhs(q, p, tau if tau.shape[-1] else None, self.prepare())
        return torch.cat([qd, force, torch.zeros_like(tau)], dim=-1)


class DenseInputDynamics(NetworkDynamics):
    """G(q) is diagonal: a network with an output for each of the three axes of a joint, of which z moves."""

    def __init__(self, *, input_network: MaskedNetwork, **parts: Any) -> None:
        super().__init__(**parts)
        self.moving = nn.Buffer(torch.eye(3 * self.n).double()[2::3])
        self.input_network = input_network

    def prepare(self) -> dict[str, Parameters]:
        """Return the parameter caches of all networks: also of the input matrix."""
        return super().prepare() | {"input": self.input_network.prepare(self.moving, self.moving.sum(dim=1))}

    def _gains(self, cache: NetworkConfiguration) -> Tensor:
        """Return the diagonal of G, (..., n)."""
        return self.input_network.forward(cache.encoded, cache.parameters["input"])[0]

    def input_matrix(self, q: Tensor) -> Tensor:
        """Return G(q), (..., n, n)."""
        return torch.diag_embed(self._gains(self.at(q)))

    def input_force(self, cache: NetworkConfiguration, qd: Tensor, tau: Tensor) -> Tensor:
        """Return G(q) tau, (..., n) [Nm, N]."""
        return self._gains(cache) * tau

    def input_torque(self, cache: NetworkConfiguration, force: Tensor) -> Tensor:
        """Return the inputs, (..., n), that give this force."""
        return force / self._gains(cache)


class NetworkFriction(nn.Module):
    """Friction by a network, in units of typical friction and typical speed."""

    prepare: Callable[[], Parameters]  # all that depends on the parameters only
    # D(q, qd) right, (..., n, k), of the encoding, qd, the parameters and right, (..., n, k)
    forward: Callable[[Tensor, Tensor, Parameters, Tensor], Tensor]

    def __init__(self, joints: Sequence[Joint], network: MaskedNetwork) -> None:
        super().__init__()
        self.speed = nn.Buffer(vector(joint.speed for joint in joints))
        self.nominal = nn.Buffer(vector(joint.friction for joint in joints))
        self.network = network


class JointFrictionParameters(NamedTuple):
    """All that depends on the parameters only."""

    layers: Layers
    viscous: Tensor  # (n,) [Nm s/rad, N s/m]
    smoothing: Tensor  # squared smoothing velocity, (n,)


class JointFriction(NetworkFriction):
    """A diagonal D(q, qd), positive for all parameters: viscous constants, and a network for dry friction."""

    parameter_groups = (
        ("raw_viscous", "sizes", "Nm s/rad, N s/m"),
        ("raw_smoothing", "velocities", "rad/s, m/s"),
    )

    def __init__(self, joints: Sequence[Joint], network: MaskedNetwork) -> None:
        super().__init__(joints, network)
        self.raw_smoothing = nn.Parameter(torch.zeros_like(self.speed))
        self.raw_viscous = nn.Parameter(torch.full_like(self.speed, -2.0))

    def viscous(self) -> Tensor:
        """Return the viscous coefficients, (n,) [Nm s/rad, N s/m]."""
        return self.nominal * F.softplus(self.raw_viscous) / self.speed

    def prepare(self) -> JointFrictionParameters:
        """Return the parameter cache."""
        # velocity below which dry friction goes to zero, relative to the typical speed: at first 0.03
        smoothing = self.speed**2 * (0.001**2 + (0.03 * self.raw_smoothing.exp()) ** 2)
        start = torch.full_like(self.speed, -2.0)
        layers = self.network.prepare(torch.diag(0 * start + 1), start)
        return JointFrictionParameters(layers, self.viscous(), smoothing)

    def forward(
        self, encoded: Tensor, qd: Tensor, parameters: JointFrictionParameters, right: Tensor
    ) -> Tensor:
        """Return D(q, qd) right, (..., n, k)."""
        layers, viscous, smoothing = parameters
        smooth_speed = torch.sqrt(qd * qd + smoothing)
        inputs = torch.cat([encoded, qd, qd / smooth_speed], dim=-1)
        # dry friction relative to its typical magnitude
        dry = F.softplus(self.network.forward(inputs, layers)[0])
        diagonal: Tensor = viscous + self.nominal * dry / smooth_speed
        return diagonal.unsqueeze(-1) * right


class DenseFriction(NetworkFriction):
    """D(q, qd) = L L^T, with ``axes`` rows of L for each joint.

    A joint moves along the last of its axes only, so only those rows of L are computed.
    """

    def __init__(self, joints: Sequence[Joint], network: MaskedNetwork, axes: int) -> None:
        super().__init__(joints, network)
        rows = axes * len(joints)
        row, column = torch.tril_indices(rows, rows)
        # from the entries of a lower triangle, rows in sequence, to the matrix: (rows, rows, entries)
        spread = torch.eye(rows * rows).double()[:, rows * row + column].reshape(rows, rows, -1)
        self.entries = nn.Buffer(spread[axes - 1 :: axes])
        # initial diagonal of L, relative to the root of typical friction per typical speed
        self.initial = nn.Buffer(0.35 * torch.eye(rows).double()[axes - 1 :: axes])

    def prepare(self) -> Layers:
        """Return the layers that give the rows of L."""
        size = torch.sqrt(self.nominal / self.speed).unsqueeze(-1)
        output_map = (size.unsqueeze(-1) * self.entries).flatten(0, 1)
        return self.network.prepare(output_map, (size * self.initial).flatten())

    def forward(self, encoded: Tensor, qd: Tensor, layers: Layers, right: Tensor) -> Tensor:
        """Return D(q, qd) right, (..., n, k)."""
        rows = self.network.forward(torch.cat([encoded, qd / self.speed], dim=-1), layers)[0]
        factor = rows.reshape(*qd.shape[:-1], *self.initial.shape)
        return factor @ (factor.mT @ right)
