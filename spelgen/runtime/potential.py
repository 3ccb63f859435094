"""V(q): a network, beside a Fourier series where one is short."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from spelgen.runtime.configuration import Configuration
from spelgen.runtime.fourier import FourierFeatures, FourierSeries, Term
from spelgen.runtime.network import Network


class PotentialPrepared(NamedTuple):
    """What depends on the weights alone."""

    layers: Any  # of the network
    energy: Tensor | None  # takes Fourier features to V, (2 K,)
    gradient: Tensor | None  # and to dV/dq, (2 K, n)


class LearnedPotential(nn.Module):
    """V(q) [J], of one network and, with ``series``, one Fourier series, both in units of ``scale``."""

    scale: Tensor

    def __init__(
        self,
        scale: float,
        network: Network,
        fourier: FourierFeatures | None = None,
        series: Sequence[Term] = (),
        sensitivity: Sequence[float] = (),
    ) -> None:
        super().__init__()
        self.register_buffer("scale", torch.full((1, 1), scale, dtype=torch.float64))
        self.network, self.fourier = network, fourier
        self.series: FourierSeries | None = None
        if fourier is not None:
            self.series = FourierSeries(fourier, [series], [scale], sensitivity)

    def prepare(self) -> PotentialPrepared:
        """All that depends on the weights alone."""
        layers = self.network.prepare(self.scale, 0 * self.scale[0])
        if self.series is None or self.fourier is None:
            return PotentialPrepared(layers, None, None)
        energy = self.series.prepare(self.scale)[0]
        return PotentialPrepared(layers, energy, self.fourier.gradient_map(energy))

    def forward(self, at: Configuration, prepared: PotentialPrepared) -> Tensor:
        """V(q), (...) [J]."""
        energy: Tensor = self.network(at.encoded, prepared.layers)[0].squeeze(-1)
        if at.fourier is None or prepared.energy is None:
            return energy
        return energy + at.fourier @ prepared.energy

    def network_vjp(self, at: Configuration, prepared: PotentialPrepared) -> Tensor:
        """The derivative of the network's part of V by the encoding."""
        _, residuals = self.network(at.encoded, prepared.layers)
        return self.network.vjp(residuals, at.encoded.new_ones(1))
