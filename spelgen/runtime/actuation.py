"""Inputs that are not the torques of single joints: motors behind gears and couplings, or a network's."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from spelgen.runtime.joints import Joints
from spelgen.runtime.network_dynamics import NetworkDynamics, NetworkPose, NetworkPrepared
from spelgen.runtime.parts import Friction, Mass, Network, Pose
from spelgen.runtime.port_hamiltonian import PortHamiltonian


class MotorInput(PortHamiltonian):
    """G, (n, n), of gears and couplings between motors and joints, some of them trained.

    A trained gain starts at its value and keeps its sign.
    """

    kinds = (("raw_gains", "gains", "1"),)

    motor_gains: tuple[tuple[int, int, float, bool], ...]  # joint, motor, torque by torque, whether trained
    raw_gains: nn.Parameter | None

    def __init__(self, joints: Joints) -> None:
        super().__init__(joints)
        constant, trained = torch.zeros(2, joints.n, joints.n, dtype=torch.float64)
        for joint, motor, value, is_trained in self.motor_gains:
            (trained if is_trained else constant)[joint, motor] = value
        self.constant_gains = nn.Buffer(constant)
        self.trained_gains = nn.Buffer(trained)
        rows = [joint for joint, _, _, is_trained in self.motor_gains if is_trained]
        self.gain_rows = nn.Buffer(torch.tensor(rows, dtype=torch.long))  # the joints of the trained gains
        raw = nn.Parameter(torch.zeros(len(rows), dtype=torch.float64)) if rows else None
        self.register_parameter("raw_gains", raw)

    def gains(self) -> Tensor:
        """Return G, (n, n): joint torques by motor torques."""
        if self.raw_gains is None:
            return self.constant_gains
        gain = torch.ones_like(self.actuated).index_put((self.gain_rows,), self.raw_gains.exp())
        return self.constant_gains + gain.unsqueeze(-1) * self.trained_gains

    def input_matrix(self, q: Tensor) -> Tensor:
        """Return G, (..., n, n)."""
        return self.gains().expand(*q.shape, -1)

    def input_force(self, pose: Pose, qd: Tensor, tau: Tensor) -> Tensor:
        """Return G tau, (..., n) [Nm, N]."""
        return tau @ self.gains().mT

    def input_torque(self, pose: Pose, qd: Tensor, force: Tensor) -> Tensor:
        """Return the inputs, (..., n), that make this force; a passive joint shows the torque it lacks."""
        matrix = self.gains() + torch.diag(1 - self.actuated)
        tau: Tensor = torch.linalg.solve(matrix, force.unsqueeze(-1))
        return tau.squeeze(-1)


class DenseInput(NetworkDynamics):
    """G(q) of a network, over all three axes of every joint, of which z moves."""

    def __init__(
        self,
        joints: Joints,
        mass: Mass,
        potential: Network | None,
        scale: float,
        friction: Friction,
        network: Network,
    ) -> None:
        super().__init__(joints, mass, potential, scale, friction)
        self.moving = nn.Buffer(torch.eye(3 * joints.n).double()[2::3])
        self.input_network = network

    def prepare(self) -> NetworkPrepared:
        """Return all that depends on the weights alone."""
        layers = self.input_network.prepare(self.moving, self.moving.sum(dim=1))
        return super().prepare()._replace(input=layers)

    def _gains(self, pose: NetworkPose) -> Tensor:
        """Return the diagonal of G, (..., n)."""
        return self.input_network.forward(pose.encoded, pose.prepared.input)[0]

    def input_matrix(self, q: Tensor) -> Tensor:
        """Return G(q), (..., n, n), diagonal."""
        return torch.diag_embed(self._gains(self.at(q)))

    def input_force(self, pose: NetworkPose, qd: Tensor, tau: Tensor) -> Tensor:
        """Return G(q) tau, (..., n)."""
        return self._gains(pose) * tau

    def input_torque(self, pose: NetworkPose, qd: Tensor, force: Tensor) -> Tensor:
        """Return the inputs, (..., n), that make this force."""
        return force / self._gains(pose)
