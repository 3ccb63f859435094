"""Inputs of an arm: motors with gears and couplings, and position servos with commanded positions."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from spelgen.runtime.parts import Rows, applied
from spelgen.runtime.rows import vector


class MotorInputs(nn.Module):
    """A constant input matrix G, (n, n): entry (i, j) is the torque of joint i per input of motor j.

    Motors may drive several joints (couplings). A joint without a motor is passive: its row of G is zero. A
    trained entry is its initial value times a positive factor, so training cannot change its sign.

    Args:
        gains: rows of G, with the initial values of trained entries.
        trained: rows of a mask, True for entries of G that are trained. None: all entries are constant.
    """

    parameter_groups = (("raw_gains", "gains", "1"),)

    raw_gains: nn.Parameter | None  # log(gain / initial gain) of each trained gain, (trained,)

    def __init__(self, gains: Rows, trained: Rows | None = None) -> None:
        super().__init__()
        matrix = torch.tensor(gains, dtype=torch.float64)
        is_trained = torch.zeros_like(matrix) if trained is None else torch.tensor(trained).double()
        self.constant_gains, self.trained_gains = (
            nn.Buffer((1 - is_trained) * matrix),
            nn.Buffer(is_trained * matrix),
        )
        self.passive = nn.Buffer(1.0 - matrix.any(dim=1).double())  # 1 for a joint without a motor, (n,)
        self.gain_rows = nn.Buffer(is_trained.nonzero()[:, 0])  # joint of each gain, (trained,)
        raw = (
            nn.Parameter(torch.zeros(len(self.gain_rows), dtype=torch.float64))
            if len(self.gain_rows)
            else None
        )
        self.register_parameter("raw_gains", raw)

    def gains(self) -> Tensor:
        """Return the input matrix G, (n, n): joint torque per input of a motor."""
        if self.raw_gains is None:
            return self.constant_gains
        raw = self.raw_gains
        gain = torch.ones_like(self.passive).expand(*raw.shape[:-1], -1)
        gain = gain.index_copy(-1, self.gain_rows, raw.exp())
        return self.constant_gains + gain.unsqueeze(-1) * self.trained_gains

    def force(self, tau: Tensor) -> Tensor:
        """Return the joint torques G tau, (..., n) [Nm, N], with the input matrix G of ``gains``.

        tau: inputs of the motors, (..., n), usually motor torques [Nm, N].
        """
        return applied(self.gains(), tau)

    def torque(self, force: Tensor) -> Tensor:
        """Return the motor inputs tau, (..., n), that solve G tau = force, with the input matrix G.

        force: joint torques, (..., n) [Nm, N]. A passive joint has no input. Its element of the result is
        its element of ``force``: the torque that no motor provides.
        """
        matrix = self.gains() + torch.diag(self.passive)
        tau: Tensor = torch.linalg.solve(matrix, force.unsqueeze(-1))
        return tau.squeeze(-1)


class ServoConstants(NamedTuple):
    """Constants of all position servos, (n,): kp, kd and torque limit are positive, the dead zone is >= 0."""

    kp: Tensor  # servo torque per position error [Nm/rad, N/m]
    kd: Tensor  # servo torque per velocity [Nm s/rad, N s/m]
    limit: Tensor  # largest magnitude of the servo torque [Nm, N]
    dead_zone: Tensor  # half the width of the dead zone of the position error [rad, m]


class PositionServo(nn.Module):
    """Position servos: tau = clip(kp d(u - q) - kd qd, -limit, limit), u commanded ``delay`` seconds earlier.

    u is the commanded position, q and qd are the position and velocity of a joint. d(x) is x reduced in
    magnitude by half the width of a dead zone, and 0 within the dead zone, which is due to gear backlash or
    to the controller. A servo is a spring and a damper: the spring stores the energy 1/2 kp d(q - u)^2, so
    the arm with the input u is port-Hamiltonian. The trained parameters are logarithms of kp and kd,
    relative to the given values. Delay and dead zone are buffers: initially 0, set by a fit to commands.

    Args:
        kp: initial kp, (n,) [Nm/rad, N/m].
        kd: initial kd, (n,) [Nm s/rad, N s/m].
        limit: largest magnitude of the servo torque, (n,) [Nm, N]. None: unlimited.
        known: True for joints whose kp is known and not trained, (n,).
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
        self.delay = nn.Buffer(torch.zeros((), dtype=torch.float64))  # delay of all commands [s]
        # The dead zone is a buffer, not a parameter: training must not change it; a fit to commands sets it.
        self.dead_zone = nn.Buffer(torch.zeros(len(kp), dtype=torch.float64))
        self.raw_kp = nn.Parameter(torch.zeros(len(kp), dtype=torch.float64))
        self.raw_kd = nn.Parameter(torch.zeros(len(kp), dtype=torch.float64))

    def kp(self) -> Tensor:
        """Return kp, the servo torque per position error, (n,) [Nm/rad, N/m]."""
        return self.nominal_kp * (self.trained * self.raw_kp).exp()

    def kd(self) -> Tensor:
        """Return kd, the servo torque per joint velocity, (n,) [Nm s/rad, N s/m]."""
        return self.nominal_kd * self.raw_kd.exp()

    def prepare(self) -> ServoConstants:
        """Return the constants of all servos in SI units."""
        return ServoConstants(self.kp(), self.kd(), self.limit, self.dead_zone.clamp(min=0))

    def forward(self, u: Tensor, q: Tensor, qd: Tensor) -> Tensor:
        """Return the servo torques, (..., n) [Nm, N].

        Args:
            u: commanded positions, already delayed by ``delay``, (..., n) [rad, m].
            q: joint positions, (..., n) [rad, m].
            qd: joint velocities, (..., n) [rad/s, m/s].
        """
        kp, kd, limit, dead_zone = self.prepare()
        return (kp * beyond(u - q, dead_zone) - kd * qd).clamp(-limit, limit)

    def stored_energy(self, u: Tensor, q: Tensor) -> Tensor:
        """Return the elastic energy 1/2 kp d(q - u)^2 of all servos, summed over the joints, (...) [J].

        d(x) is x reduced in magnitude by half the width of the dead zone. u: commanded positions, (..., n)
        [rad, m]. q: joint positions, (..., n) [rad, m].
        """
        return 0.5 * (self.kp() * beyond(q - u, self.dead_zone.clamp(min=0)) ** 2).sum(dim=-1)


def beyond(distance: Tensor, dead_zone: Tensor) -> Tensor:
    """Return the parts of distances x beyond a dead zone, (..., n), with the signs of the distances.

    The result is x - dead_zone above the dead zone, x + dead_zone below it, and 0 within it.

    Args:
        distance: signed distances x from the middle of the dead zone, (..., n) [rad, m].
        dead_zone: half the width of the dead zone, (n,) [rad, m].
    """
    return distance - distance.clamp(-dead_zone, dead_zone)
