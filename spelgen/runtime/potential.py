"""V(q) of a network."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from spelgen.runtime.parts import Network


class LearnedPotential(nn.Module):
    """V(q) [J], of one network, in units of ``scale``."""

    scale: Tensor

    def __init__(self, scale: float, network: Network) -> None:
        super().__init__()
        self.register_buffer("scale", torch.full((1, 1), scale, dtype=torch.float64))
        self.network = network

    def prepare(self) -> Any:
        """All that depends on the weights alone."""
        return self.network.prepare(self.scale, 0 * self.scale[0])

    def forward(self, encoded: Tensor, prepared: Any) -> Tensor:
        """V(q), (...) [J]."""
        return self.network.forward(encoded, prepared)[0].squeeze(-1)

    def vjp(self, encoded: Tensor, prepared: Any) -> Tensor:
        """The derivative of V by the encoding."""
        _, residuals = self.network.forward(encoded, prepared)
        return self.network.vjp(residuals, encoded.new_ones(1))
