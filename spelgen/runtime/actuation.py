"""G: what the inputs do to the joints."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from spelgen.runtime.joints import Joints, vector
from spelgen.runtime.parts import Network


class DirectInput(nn.Module):
    """G is the identity: each input is the torque of its own joint, and none that of a passive one."""

    actuated: Tensor

    def __init__(self, joints: Joints) -> None:
        super().__init__()
        self.register_buffer("actuated", vector(float(x) for x in joints.actuated))

    def prepare(self) -> Tensor:
        """Return the diagonal of G, (n,)."""
        return self.actuated

    def forward(self, encoded: Tensor, prepared: Tensor) -> Tensor:
        """Return G, (..., n, n)."""
        return torch.diag(prepared).expand(*encoded.shape[:-1], -1, -1)

    def force(self, encoded: Tensor, tau: Tensor, prepared: Tensor) -> Tensor:
        """Return G tau, (..., n)."""
        return prepared * tau

    def solve(self, encoded: Tensor, force: Tensor, prepared: Tensor) -> Tensor:
        """Return the inputs, (..., n), that make this force; a passive joint shows the torque it lacks."""
        return force


class MotorGain(NamedTuple):
    """What the torque of a motor does to a joint; a trained one starts at ``value``, keeps its sign."""

    joint: int
    motor: int
    value: float
    trained: bool


class MotorInput(nn.Module):
    """G, (n, n), of gears and couplings between motors and joints, some of them trained."""

    kinds = (("raw_gains", "gains", "1"),)

    actuated: Tensor
    constant: Tensor
    trained: Tensor
    rows: Tensor  # of the trained gains
    raw_gains: nn.Parameter | None

    def __init__(self, joints: Joints, gains: Sequence[MotorGain]) -> None:
        super().__init__()
        n = joints.n
        constant, trained = torch.zeros(2, n, n, dtype=torch.float64)
        for gain in gains:
            (trained if gain.trained else constant)[gain.joint, gain.motor] = gain.value
        self.register_buffer("actuated", vector(float(x) for x in joints.actuated))
        self.register_buffer("constant", constant)
        self.register_buffer("trained", trained)
        rows = [gain.joint for gain in gains if gain.trained]
        self.register_buffer("rows", torch.tensor(rows, dtype=torch.long))
        raw = nn.Parameter(torch.zeros(len(rows), dtype=torch.float64)) if rows else None
        self.register_parameter("raw_gains", raw)

    def prepare(self) -> Tensor:
        """G, (n, n)."""
        if self.raw_gains is None:
            return self.constant
        gain = torch.ones_like(self.actuated).index_put((self.rows,), self.raw_gains.exp())
        return self.constant + gain.unsqueeze(-1) * self.trained

    def forward(self, encoded: Tensor, prepared: Tensor) -> Tensor:
        """G, (..., n, n): joint torques by motor torques."""
        return prepared.expand(*encoded.shape[:-1], *prepared.shape)

    def force(self, encoded: Tensor, tau: Tensor, prepared: Tensor) -> Tensor:
        """G tau, (..., n)."""
        return tau @ prepared.mT

    def solve(self, encoded: Tensor, force: Tensor, prepared: Tensor) -> Tensor:
        """The inputs, (..., n), that make this force; a passive joint shows the torque it lacks."""
        moved = prepared + torch.diag(1 - self.actuated)
        solution: Tensor = torch.linalg.solve(moved, force.unsqueeze(-1))
        return solution.squeeze(-1)


class DenseInput(nn.Module):
    """G(q) of a network, over all three axes of every joint, of which z moves."""

    moving: Tensor

    def __init__(self, joints: Joints, network: Network) -> None:
        super().__init__()
        self.register_buffer("moving", torch.eye(3 * joints.n).double()[2::3])
        self.network = network

    def prepare(self) -> Any:
        """The network's weights made ready for many states."""
        return self.network.prepare(self.moving, self.moving.sum(dim=1))

    def _gains(self, encoded: Tensor, prepared: Any) -> Tensor:
        return self.network.forward(encoded, prepared)[0]

    def forward(self, encoded: Tensor, prepared: Any) -> Tensor:
        """G(q), (..., n, n), diagonal."""
        return torch.diag_embed(self._gains(encoded, prepared))

    def force(self, encoded: Tensor, tau: Tensor, prepared: Any) -> Tensor:
        """G(q) tau, (..., n)."""
        return self._gains(encoded, prepared) * tau

    def solve(self, encoded: Tensor, force: Tensor, prepared: Any) -> Tensor:
        """The inputs, (..., n), that make this force."""
        return force / self._gains(encoded, prepared)
