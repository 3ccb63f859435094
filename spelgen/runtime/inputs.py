"""The input matrix of motors behind gears and couplings."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from spelgen.runtime.parts import Rows
from spelgen.runtime.port_hamiltonian import applied


class MotorInputs(nn.Module):
    """A constant G, (n, n): torque of each joint, its rows, per input of each motor, its columns.

    A joint without a motor is passive. trained: rows of G, true for gains that are trained; such a gain
    keeps its sign.
    """

    parameter_groups = (("raw_gains", "gains", "1"),)

    raw_gains: nn.Parameter | None  # logarithms, relative to the initial values

    def __init__(self, gains: Rows, trained: Rows | None = None) -> None:
        super().__init__()
        matrix = torch.tensor(gains, dtype=torch.float64)
        is_trained = torch.zeros_like(matrix) if trained is None else torch.tensor(trained).double()
        self.constant_gains, self.trained_gains = (
            nn.Buffer((1 - is_trained) * matrix),
            nn.Buffer(is_trained * matrix),
        )
        self.passive = nn.Buffer(1.0 - matrix.any(dim=1).double())  # 1 for a joint without a motor, (n,)
        self.gain_rows = nn.Buffer(is_trained.nonzero()[:, 0])  # joints of the trained gains
        raw = (
            nn.Parameter(torch.zeros(len(self.gain_rows), dtype=torch.float64))
            if len(self.gain_rows)
            else None
        )
        self.register_parameter("raw_gains", raw)

    def gains(self) -> Tensor:
        """Return G, (n, n): joint torque per motor torque."""
        if self.raw_gains is None:
            return self.constant_gains
        raw = self.raw_gains
        gain = torch.ones_like(self.passive).expand(*raw.shape[:-1], -1)
        gain = gain.index_copy(-1, self.gain_rows, raw.exp())
        return self.constant_gains + gain.unsqueeze(-1) * self.trained_gains

    def force(self, tau: Tensor) -> Tensor:
        """Return G tau, (..., n) [Nm, N]."""
        return applied(self.gains(), tau)

    def torque(self, force: Tensor) -> Tensor:
        """Return the inputs, (..., n), for this force; at a passive joint, the force required there."""
        matrix = self.gains() + torch.diag(self.passive)
        tau: Tensor = torch.linalg.solve(matrix, force.unsqueeze(-1))
        return tau.squeeze(-1)
