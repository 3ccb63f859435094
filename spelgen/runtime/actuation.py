"""Inputs that are not the torques of single joints: motors behind gears and couplings, or a network's."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from spelgen.runtime.joints import Joints
from spelgen.runtime.network_dynamics import NetworkDynamics, NetworkPose
from spelgen.runtime.parts import Friction, Mass, Network, Pose, Prepared
from spelgen.runtime.port_hamiltonian import PortHamiltonian, applied


class MotorInput(PortHamiltonian):
    """G, (n, n), of gears and couplings between motors and joints, some of them trained, and passive joints.

    A trained gain starts at its value and keeps its sign.
    """

    kinds = (("raw_gains", "gains", "1"),)

    motor_gains: tuple[tuple[int, int, float, bool], ...]  # joint, motor, torque by torque, whether trained
    raw_gains: nn.Parameter | None

    def __init__(self) -> None:
        super().__init__()
        constant, trained = torch.zeros(2, self.n, self.n, dtype=torch.float64)
        for joint, motor, value, is_trained in self.motor_gains:
            (trained if is_trained else constant)[joint, motor] = value
        self.constant_gains, self.trained_gains = nn.Buffer(constant), nn.Buffer(trained)
        # 1 where no motor moves a joint, (n,)
        self.passive = nn.Buffer(1.0 - (constant + trained).any(dim=1).double())
        rows = [joint for joint, _, _, is_trained in self.motor_gains if is_trained]
        self.gain_rows = nn.Buffer(torch.tensor(rows, dtype=torch.long))  # the joints of the trained gains
        raw = nn.Parameter(torch.zeros(len(rows), dtype=torch.float64)) if rows else None
        self.register_parameter("raw_gains", raw)

    def gains(self) -> Tensor:
        """Return G, (n, n): joint torques by motor torques."""
        if self.raw_gains is None:
            return self.constant_gains
        raw = self.raw_gains
        gain = torch.ones_like(self.passive).expand(*raw.shape[:-1], -1)
        gain = gain.index_copy(-1, self.gain_rows, raw.exp())
        return self.constant_gains + gain.unsqueeze(-1) * self.trained_gains

    def input_matrix(self, q: Tensor) -> Tensor:
        """Return G, (..., n, n)."""
        return self.gains().expand(*q.shape, -1)

    def input_force(self, pose: Pose, qd: Tensor, tau: Tensor) -> Tensor:
        """Return G tau, (..., n) [Nm, N]."""
        return applied(self.gains(), tau)

    def input_torque(self, pose: Pose, force: Tensor) -> Tensor:
        """Return the inputs, (..., n), that make this force; a passive joint shows the torque it lacks."""
        matrix = self.gains() + torch.diag(self.passive)
        tau: Tensor = torch.linalg.solve(matrix, force.unsqueeze(-1))
        return tau.squeeze(-1)


class DenseInput(NetworkDynamics):
    """G(q) of a network, over all three axes of every joint, of which z moves."""

    def __init__(
        self,
        joints: Joints,
        mass: Mass,
        energy: Network,
        scale: float,
        friction: Friction,
        network: Network,
    ) -> None:
        super().__init__(joints, mass, energy, scale, friction)
        self.moving = nn.Buffer(torch.eye(3 * len(joints.speed)).double()[2::3])
        self.input_network = network

    def prepare(self) -> Prepared:
        """Return all that depends on the weights alone."""
        return super().prepare() | {"input": self.input_network.prepare(self.moving, self.moving.sum(dim=1))}

    def _gains(self, pose: NetworkPose) -> Tensor:
        """Return the diagonal of G, (..., n)."""
        return self.input_network.forward(pose.encoded, pose.prepared["input"])[0]

    def input_matrix(self, q: Tensor) -> Tensor:
        """Return G(q), (..., n, n), diagonal."""
        return torch.diag_embed(self._gains(self.at(q)))

    def input_force(self, pose: NetworkPose, qd: Tensor, tau: Tensor) -> Tensor:
        """Return G(q) tau, (..., n)."""
        return self._gains(pose) * tau

    def input_torque(self, pose: NetworkPose, force: Tensor) -> Tensor:
        """Return the inputs, (..., n), that make this force."""
        return force / self._gains(pose)
