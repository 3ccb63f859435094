"""Networks of all quantities, with an input matrix G(q) that is a network too."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from spelgen.runtime.network_dynamics import NetworkConfiguration, NetworkDynamics
from spelgen.runtime.parts import Network, Parameters


class DenseInputDynamics(NetworkDynamics):
    """G(q) is diagonal: a network with an output for each of the three axes of a joint, of which z moves."""

    def __init__(self, *, input_network: Network, **parts: Any) -> None:
        super().__init__(**parts)
        self.moving = nn.Buffer(torch.eye(3 * self.n).double()[2::3])
        self.input_network = input_network

    def prepare(self) -> dict[str, Parameters]:
        """Return the parameter cache, by part."""
        return super().prepare() | {"input": self.input_network.prepare(self.moving, self.moving.sum(dim=1))}

    def _gains(self, cache: NetworkConfiguration) -> Tensor:
        """Return the diagonal of G, (..., n)."""
        return self.input_network.forward(cache.encoded, cache.parameters["input"])[0]

    def input_matrix(self, q: Tensor) -> Tensor:
        """Return G(q), (..., n, n)."""
        return torch.diag_embed(self._gains(self.at(q)))

    def input_force(self, cache: NetworkConfiguration, qd: Tensor, tau: Tensor) -> Tensor:
        """Return G(q) tau, (..., n) [Nm, N]."""
        return self._gains(cache) * tau

    def input_torque(self, cache: NetworkConfiguration, force: Tensor) -> Tensor:
        """Return the inputs, (..., n), that give this force."""
        return force / self._gains(cache)
