"""Position servos: what stands between a commanded position and the torque of a joint."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from spelgen.runtime.joints import vector


class ServoConstants(NamedTuple):
    """By joint, (n,), all positive."""

    kp: Tensor  # [Nm/rad, N/m]
    kd: Tensor  # [Nm s/rad, N s/m]
    limit: Tensor  # [Nm, N]


class PositionServo(nn.Module):
    """tau = clip(kp (u - q) - kd qd, -limit, limit), where u was commanded ``delay`` seconds ago.

    A spring and a damper towards the command: the spring stores 1/2 kp (q - u)^2, so that an arm that
    servos hold is port-Hamiltonian too, with u as its input. The weights are logarithms.
    """

    nominal_kp: Tensor
    nominal_kd: Tensor
    trained: Tensor
    limit: Tensor
    delay: Tensor

    def __init__(
        self, kp: Sequence[float], kd: Sequence[float], limit: Sequence[float], known: Sequence[bool]
    ) -> None:
        super().__init__()
        self.register_buffer("nominal_kp", vector(kp))
        self.register_buffer("nominal_kd", vector(kd))
        self.register_buffer("trained", vector(float(not x) for x in known))
        self.register_buffer("limit", vector(limit))
        self.register_buffer("delay", torch.zeros((), dtype=torch.float64))  # [s]
        self.raw_kp = nn.Parameter(torch.zeros(len(kp), dtype=torch.float64))
        self.raw_kd = nn.Parameter(torch.zeros(len(kp), dtype=torch.float64))

    def kp(self) -> Tensor:
        """Torque by the distance from the command, (n,) [Nm/rad, N/m]."""
        return self.nominal_kp * (self.trained * self.raw_kp).exp()

    def kd(self) -> Tensor:
        """Torque by velocity, (n,) [Nm s/rad, N s/m]."""
        return self.nominal_kd * self.raw_kd.exp()

    def prepare(self) -> ServoConstants:
        """The constants, in their units."""
        return ServoConstants(self.kp(), self.kd(), self.limit)

    def forward(self, u: Tensor, q: Tensor, qd: Tensor) -> Tensor:
        """The torque, (..., n) [Nm, N], under the delayed command u, (..., n)."""
        kp, kd, limit = self.prepare()
        return (kp * (u - q) - kd * qd).clamp(-limit, limit)

    def stored_energy(self, u: Tensor, q: Tensor) -> Tensor:
        """What the springs give back, (...) [J]."""
        return 0.5 * (self.kp() * (q - u) ** 2).sum(dim=-1)
