"""Position servos: joint torques from commanded positions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from spelgen.runtime.rows import vector


class ServoConstants(NamedTuple):
    """The constants of all servos, (n,), positive."""

    kp: Tensor  # [Nm/rad, N/m]
    kd: Tensor  # [Nm s/rad, N s/m]
    limit: Tensor  # [Nm, N]
    dead_zone: Tensor  # half width [rad, m]; may be 0


class PositionServo(nn.Module):
    """tau = clip(kp d(u - q) - kd qd, -limit, limit), where u was commanded ``delay`` seconds earlier.

    d(x) is x reduced by the dead zone, zero within it: of gears with play, or of the controller itself. The
    servo is a spring and a damper; the spring stores 1/2 kp d(q - u)^2, so that the arm is port-Hamiltonian
    with the input u. The trained parameters are logarithms. A known kp is not trained.
    """

    parameter_groups = (
        ("raw_kp", "stiffness", "Nm/rad, N/m"),
        ("raw_kd", "damping", "Nm s/rad, N s/m"),
        ("dead_zone", "dead_zone", "rad, m"),
        ("delay", "delay", "s"),
    )

    def __init__(
        self,
        *,
        kp: Sequence[float],
        kd: Sequence[float],
        limit: Sequence[float | None],
        known: Sequence[bool],
    ) -> None:
        super().__init__()
        self.nominal_kp = nn.Buffer(vector(kp))
        self.nominal_kd = nn.Buffer(vector(kd))
        self.trained = nn.Buffer(vector(float(not x) for x in known))
        self.limit = nn.Buffer(vector(math.inf if x is None else x for x in limit))
        self.delay = nn.Buffer(torch.zeros((), dtype=torch.float64))  # [s]
        # a buffer: only a fit to commands may set it
        self.dead_zone = nn.Buffer(torch.zeros(len(kp), dtype=torch.float64))
        self.raw_kp = nn.Parameter(torch.zeros(len(kp), dtype=torch.float64))
        self.raw_kd = nn.Parameter(torch.zeros(len(kp), dtype=torch.float64))

    def kp(self) -> Tensor:
        """Return the torque per distance from the command, (n,) [Nm/rad, N/m]."""
        return self.nominal_kp * (self.trained * self.raw_kp).exp()

    def kd(self) -> Tensor:
        """Return the torque per velocity, (n,) [Nm s/rad, N s/m]."""
        return self.nominal_kd * self.raw_kd.exp()

    def prepare(self) -> ServoConstants:
        """Return the constants in SI units."""
        return ServoConstants(self.kp(), self.kd(), self.limit, self.dead_zone.clamp(min=0))

    def forward(self, u: Tensor, q: Tensor, qd: Tensor) -> Tensor:
        """Return the torque, (..., n) [Nm, N], for the delayed command u, (..., n)."""
        kp, kd, limit, dead_zone = self.prepare()
        return (kp * beyond(u - q, dead_zone) - kd * qd).clamp(-limit, limit)

    def stored_energy(self, u: Tensor, q: Tensor) -> Tensor:
        """Return the elastic energy of the springs, (...) [J]."""
        return 0.5 * (self.kp() * beyond(q - u, self.dead_zone.clamp(min=0)) ** 2).sum(dim=-1)


def beyond(distance: Tensor, dead_zone: Tensor) -> Tensor:
    """Return distances, (..., n), reduced by half the width of a dead zone, (n,); zero within it."""
    return distance - distance.clamp(-dead_zone, dead_zone)
