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
    dead_zone: Tensor  # half its width [rad, m]; may be 0


class PositionServo(nn.Module):
    """tau = clip(kp d(u - q) - kd qd, -limit, limit), where u was commanded ``delay`` seconds ago.

    d is what a distance is beyond the dead zone, if there is one: no torque comes of less, as where
    gears have play behind the spring, or where the servo itself leaves it. A spring and a damper
    towards the command: the spring stores 1/2 kp d(q - u)^2, so that an arm that servos hold is
    port-Hamiltonian too, with u as its input. The weights are logarithms.
    """

    kinds = (
        ("raw_kp", "stiffness", "Nm/rad, N/m"),
        ("raw_kd", "damping", "Nm s/rad, N s/m"),
        ("dead_zone", "dead_zone", "rad, m"),
        ("delay", "delay", "s"),
    )

    def __init__(
        self, kp: Sequence[float], kd: Sequence[float], limit: Sequence[float], known: Sequence[bool]
    ) -> None:
        super().__init__()
        self.nominal_kp = nn.Buffer(vector(kp))
        self.nominal_kd = nn.Buffer(vector(kd))
        self.trained = nn.Buffer(vector(float(not x) for x in known))
        self.limit = nn.Buffer(vector(limit))
        self.delay = nn.Buffer(torch.zeros((), dtype=torch.float64))  # [s]
        # no parameter: only a fit to commands may find one
        self.dead_zone = nn.Buffer(torch.zeros(len(kp), dtype=torch.float64))
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
        return ServoConstants(self.kp(), self.kd(), self.limit, self.dead_zone.clamp(min=0))

    def forward(self, u: Tensor, q: Tensor, qd: Tensor) -> Tensor:
        """The torque, (..., n) [Nm, N], under the delayed command u, (..., n)."""
        kp, kd, limit, dead_zone = self.prepare()
        return (kp * beyond(u - q, dead_zone) - kd * qd).clamp(-limit, limit)

    def stored_energy(self, u: Tensor, q: Tensor) -> Tensor:
        """What the springs give back, (...) [J]."""
        return 0.5 * (self.kp() * beyond(q - u, self.dead_zone.clamp(min=0)) ** 2).sum(dim=-1)


def beyond(distance: Tensor, dead_zone: Tensor) -> Tensor:
    """What distances, (..., n), are beyond a dead zone, (n,), to both sides."""
    return distance - distance.clamp(-dead_zone, dead_zone)
