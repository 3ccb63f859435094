"""Port-Hamiltonian models whose mass matrix M, potential V, dissipation D and input matrix G are networks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from spelgen.runtime.motors import MotorInputs
from spelgen.runtime.networks import JointEncoding, MaskedNetwork
from spelgen.runtime.parts import Intermediates, Layers, Mass, Parameters, applied
from spelgen.runtime.port_hamiltonian import PortHamiltonian
from spelgen.runtime.rows import Joint, vector


class NetworkConfiguration(NamedTuple):
    """Configuration cache of ``NetworkDynamics``: the quantities that depend on q only, not on qd."""

    encoded: Tensor  # encoding of q, (..., 2 n), input of the networks
    mass: Tensor  # M(q), (..., n, n)
    intermediates: Intermediates  # intermediate values of M's network, for the derivatives of M
    parameters: dict[str, Parameters]


class NetworkDynamics(PortHamiltonian):
    """A model whose mass matrix M(q), potential V(q) and dissipation matrix D(q, qd) are networks.

    Args:
        joints: joints of the arm.
        mass: mass matrix M(q), see ``Mass``.
        potential: network of V / potential_scale, with the encoding of q as input.
        potential_scale: unit of V [J].
        friction: dissipation matrix D(q, qd), see ``NetworkFriction``.
        inputs: constant input matrix G; None: each input drives its own joint.
    """

    def __init__(
        self,
        *,
        joints: Sequence[Joint],
        mass: Mass,
        potential: MaskedNetwork,
        potential_scale: float,
        friction: NetworkFriction,
        inputs: MotorInputs | None = None,
    ) -> None:
        super().__init__(joints, inputs)
        self.encoding, self.mass = JointEncoding(joints), mass
        self.potential, self.friction = potential, friction
        self.scale = nn.Buffer(torch.full((1, 1), potential_scale, dtype=torch.float64))

    def prepare(self) -> dict[str, Parameters]:
        """Return the parameter caches of M, V and D, with the keys "mass", "potential" and "friction".

        M is the mass matrix, V the potential energy, D the dissipation matrix. The caches depend on the
        trained parameters only, and are valid until a parameter changes.
        """
        # The offset of V is zero, since a constant in V has no effect on the motion. It is computed as
        # 0 * scale, which has the dtype and device of the model.
        potential = self.potential.prepare(self.scale, 0 * self.scale[0])
        return {"mass": self.mass.prepare(), "potential": potential, "friction": self.friction.prepare()}

    def configuration(self, q: Tensor, parameters: dict[str, Parameters]) -> NetworkConfiguration:
        """Return the configuration cache at q, (..., n) [rad, m]; parameters: caches from ``prepare``."""
        encoded = self.encoding.forward(q)
        mass, intermediates = self.mass.forward(encoded, parameters["mass"])
        return NetworkConfiguration(encoded, mass, intermediates, parameters)

    def potential_energy(self, q: Tensor | NetworkConfiguration) -> Tensor:
        """Return the potential energy V(q), (...) [J]; q: (..., n) [rad, m], or a configuration cache."""
        cache: NetworkConfiguration = self.at(q)
        return self.potential.forward(cache.encoded, cache.parameters["potential"])[0].squeeze(-1)

    def gravity(self, q: Tensor | NetworkConfiguration) -> Tensor:
        """Return the gravity torque dV/dq, (..., n) [Nm, N]."""
        cache: NetworkConfiguration = self.at(q)
        # At rest, the gradient of the kinetic energy is zero, so the Lagrangian gradient is -dV/dq.
        return -self.lagrangian_gradient(cache, torch.zeros_like(cache.mass[..., 0]))

    def lagrangian_gradient(self, q: Tensor | NetworkConfiguration, qd: Tensor) -> Tensor:
        """Return the gradient of 1/2 qd^T M(q) qd - V(q) (Lagrangian) with respect to q, (..., n) [Nm, N]."""
        cache: NetworkConfiguration = self.at(q, qd)
        intermediates = self.potential.forward(cache.encoded, cache.parameters["potential"])[1]
        # Reverse mode: one sweep through the network of M for 1/2 qd^T M qd, one through the network of V.
        # Both results are gradients with respect to the encoding of q; `encoding.vjp` converts them to d/dq.
        kinetic = self.mass.kinetic_vjp(qd, cache.intermediates)
        return self.encoding.vjp(cache.encoded, kinetic - self.potential.vjp(intermediates, qd.new_ones(1)))

    def nonlinear_effects(self, q: Tensor | NetworkConfiguration, qd: Tensor) -> Tensor:
        """Return Coriolis, centrifugal and gravity torque, (..., n) [Nm, N].

        It is dM/dt qd - d/dq (1/2 qd^T M qd) + dV/dq.
        """
        cache: NetworkConfiguration = self.at(q, qd)
        # dM/dt is one directional derivative along qd, which takes less time than n^3 Christoffel symbols.
        mass_rate = self.mass.jvp(self.encoding.jvp(cache.encoded, qd), cache.intermediates)
        return applied(mass_rate, qd) - self.lagrangian_gradient(cache, qd)

    def friction_torque(self, q: Tensor | NetworkConfiguration, qd: Tensor) -> Tensor:
        """Return the friction torque D(q, qd) qd, (..., n) [Nm, N]."""
        cache: NetworkConfiguration = self.at(q, qd)
        layers = cache.parameters["friction"]
        return self.friction.forward(cache.encoded, qd, layers, qd.unsqueeze(-1)).squeeze(-1)

    def dissipation(self, q: Tensor | NetworkConfiguration, qd: Tensor) -> Tensor:
        """Return the dissipation matrix D(q, qd), (..., n, n) [Nm s/rad, N s/m]."""
        cache: NetworkConfiguration = self.at(q, qd)
        return self.friction.forward(
            cache.encoded, qd, cache.parameters["friction"], torch.eye(self.n).to(qd)
        )


class DenseInputDynamics(NetworkDynamics):
    """A ``NetworkDynamics`` whose input matrix G(q) is a network, too; G is diagonal.

    The network of G has three outputs per joint, one for each axis of the joint frame. Only the output of
    the z axis is used, since the joint moves about or along it: the diagonal entry of G is 1 + this
    output.
    """

    def __init__(self, *, input_network: MaskedNetwork, **parts: Any) -> None:
        super().__init__(**parts)
        self.moving = nn.Buffer(torch.eye(3 * self.n).double()[2::3])
        self.input_network = input_network

    def prepare(self) -> dict[str, Parameters]:
        """Return the parameter caches of M, V, D and G: "mass", "potential", "friction" and "input"."""
        return super().prepare() | {"input": self.input_network.prepare(self.moving, self.moving.sum(dim=1))}

    def _gains(self, cache: NetworkConfiguration) -> Tensor:
        """Return the diagonal of G(q), (..., n): joint torque per input; cache: configuration cache at q."""
        return self.input_network.forward(cache.encoded, cache.parameters["input"])[0]

    def input_matrix(self, q: Tensor) -> Tensor:
        """Return the diagonal input matrix G(q), (..., n, n): joint torque per input."""
        return torch.diag_embed(self._gains(self.at(q)))

    def input_force(self, cache: NetworkConfiguration, qd: Tensor, tau: Tensor) -> Tensor:
        """Return the joint torques G(q) tau of the inputs tau, (..., n) [Nm, N]; qd has no effect.

        cache: configuration cache at q.
        """
        return self._gains(cache) * tau

    def input_torque(self, cache: NetworkConfiguration, force: Tensor) -> Tensor:
        """Return the inputs tau, (..., n), that solve G(q) tau = ``force``, (..., n) [Nm, N].

        force: joint torques. cache: configuration cache at q.
        """
        return force / self._gains(cache)


class NetworkFriction(nn.Module):
    """Base class of dissipation matrices D(q, qd), (..., n, n), that are computed by a network.

    D [Nm s/rad, N s/m] is computed in units of typical friction / typical speed of the joints, so that
    the outputs of the network are of the order of one.
    """

    prepare: Callable[[], Parameters]  # returns the parameter cache (quantities independent of q and qd)
    # `forward` returns the product of D(q, qd) and a matrix, (..., n, k). Its arguments are the encoding of
    # q, (..., 2 n), qd, (..., n), the parameter cache, and the matrix, (..., n, k).
    forward: Callable[[Tensor, Tensor, Parameters, Tensor], Tensor]

    def __init__(self, joints: Sequence[Joint], network: MaskedNetwork) -> None:
        super().__init__()
        self.speed = nn.Buffer(vector(joint.speed for joint in joints))
        self.nominal = nn.Buffer(vector(joint.friction for joint in joints))
        self.network = network


class JointFrictionParameters(NamedTuple):
    """Parameter cache of ``JointFriction``: quantities that depend on trained parameters only."""

    layers: Layers
    viscous: Tensor  # viscous coefficients, (n,) [Nm s/rad, N s/m]
    smoothing: Tensor  # squared smoothing velocity, (n,) [rad^2/s^2, m^2/s^2]


class JointFriction(NetworkFriction):
    """A diagonal, positive definite dissipation matrix D(q, qd): viscous and dry friction of each joint.

    The diagonal is b + f softplus(output) / sqrt(qd^2 + w^2), with a network that has one output per
    joint. The viscous coefficient b [Nm s/rad, N s/m] and the smoothing velocity w of each joint are
    trained; f is the constant typical friction of its ``Joint`` [Nm, N]. At velocities below w, dry
    friction changes its sign smoothly. The inputs of the network are the encoding of q, qd and qd /
    sqrt(qd^2 + w^2).
    """

    parameter_groups = (
        ("raw_viscous", "sizes", "Nm s/rad, N s/m"),
        ("raw_smoothing", "velocities", "rad/s, m/s"),
    )

    def __init__(self, joints: Sequence[Joint], network: MaskedNetwork) -> None:
        super().__init__(joints, network)
        self.raw_smoothing = nn.Parameter(torch.zeros_like(self.speed))
        self.raw_viscous = nn.Parameter(torch.full_like(self.speed, -2.0))

    def viscous(self) -> Tensor:
        """Return the viscous friction coefficients, (n,) [Nm s/rad, N s/m]."""
        return self.nominal * F.softplus(self.raw_viscous) / self.speed

    def prepare(self) -> JointFrictionParameters:
        """Return the parameter cache: quantities that depend on trained parameters only."""
        # Dry friction is multiplied by qd / sqrt(qd^2 + smoothing). sqrt(smoothing) is a velocity: initially
        # 3 % of the typical speed, and at least 0.1 %, so that the quotient is smooth for all parameters.
        smoothing = self.speed**2 * (0.001**2 + (0.03 * self.raw_smoothing.exp()) ** 2)
        start = torch.full_like(self.speed, -2.0)
        layers = self.network.prepare(torch.diag(0 * start + 1), start)
        return JointFrictionParameters(layers, self.viscous(), smoothing)

    def forward(
        self, encoded: Tensor, qd: Tensor, parameters: JointFrictionParameters, right: Tensor
    ) -> Tensor:
        """Return D(q, qd) times ``right``, (..., n, columns), with the dissipation matrix D, (..., n, n).

        encoded: encoding of q, (..., 2 n). qd: velocities, (..., n) [rad/s, m/s]. parameters: parameter
        cache.
        """
        layers, viscous, smoothing = parameters
        smooth_speed = torch.sqrt(qd * qd + smoothing)
        inputs = torch.cat([encoded, qd, qd / smooth_speed], dim=-1)
        # `dry`: dry friction of each joint, divided by typical friction; softplus keeps it positive.
        dry = F.softplus(self.network.forward(inputs, layers)[0])
        diagonal: Tensor = viscous + self.nominal * dry / smooth_speed
        return diagonal.unsqueeze(-1) * right


class DenseFriction(NetworkFriction):
    """A dense, positive semi-definite dissipation matrix D(q, qd), (..., n, n), computed by a network.

    ``axes`` = 1: D = L L^T with a lower triangular matrix L, (n, n). ``axes`` = 3, the model of Duong et
    al., IEEE T-RO 40:3695, 2024: L L^T, (3 n, 3 n), is the dissipation matrix for all three axes of each
    joint frame. A joint moves only about or along its last axis. D is therefore K K^T, where K, (n, 3 n),
    has one row of L per joint, for this axis; the network does not compute the other rows. The inputs of
    the network are the encoding of q, and qd / typical speed.
    """

    def __init__(self, joints: Sequence[Joint], network: MaskedNetwork, axes: int) -> None:
        super().__init__(joints, network)
        rows = axes * len(joints)
        row, column = torch.tril_indices(rows, rows)
        # `spread`: linear map, (rows, rows, entries), from the entries of the lower triangle of L, in
        # row-major order, to the matrix L.
        spread = torch.eye(rows * rows).double()[:, rows * row + column].reshape(rows, rows, -1)
        self.entries = nn.Buffer(spread[axes - 1 :: axes])
        # The initial value of L is 0.35 times the identity matrix, in units of the square root of typical
        # friction / typical speed.
        self.initial = nn.Buffer(0.35 * torch.eye(rows).double()[axes - 1 :: axes])

    def prepare(self) -> Layers:
        """Return the parameter cache: layers of a network whose outputs are the entries of a factor of D.

        The factor K, (n, axes n) [sqrt(Nm s/rad), sqrt(N s/m)], gives the dissipation matrix D = K K^T,
        (n, n). It has one row per joint, for the axis of the joint frame about or along which the joint
        moves: a row of the lower triangular matrix L, (axes n, axes n), of the class.
        """
        size = torch.sqrt(self.nominal / self.speed).unsqueeze(-1)
        output_map = (size.unsqueeze(-1) * self.entries).flatten(0, 1)
        return self.network.prepare(output_map, (size * self.initial).flatten())

    def forward(self, encoded: Tensor, qd: Tensor, layers: Layers, right: Tensor) -> Tensor:
        """Return D(q, qd) times ``right``, (..., n, columns), with the dissipation matrix D, (..., n, n).

        encoded: encoding of q, (..., 2 n). qd: velocities, (..., n) [rad/s, m/s]. layers: parameter cache.
        """
        rows = self.network.forward(torch.cat([encoded, qd / self.speed], dim=-1), layers)[0]
        factor = rows.reshape(*qd.shape[:-1], *self.initial.shape)
        return factor @ (factor.mT @ right)
