"""What a model needs of its parts; an emitted module has the class of its own part under each of these names."""

from __future__ import annotations

from typing import Any, Protocol

from torch import Tensor

# what a part keeps is its own; an emitted module has the type of its own part under each of these names
Layers = Any  # a network's weights made ready for many states
NetworkResiduals = Any  # what a network's derivatives need
MassPrepared = Any  # what depends on the weights of M alone
MassResiduals = Any  # what M's derivatives need of the work done for M
FrictionPrepared = Any  # what depends on the weights of D alone
Pose = Any  # all that depends on q alone
Prepared = Any  # all that depends on the weights alone


class Network(Protocol):
    """Learned functions y of an encoding, each of its own joints, with derivatives written out."""

    def prepare(self, output_map: Tensor, offset: Tensor) -> Layers:
        """Return the weights made ready for many states, for offset + output_map y in place of y."""

    def forward(self, encoded: Tensor, layers: Layers) -> tuple[Tensor, NetworkResiduals]:
        """Return offset + output_map y, (..., rows), and residuals, which ``vjp`` and ``jvp`` need."""

    def vjp(self, residuals: NetworkResiduals, cotangent: Tensor) -> Tensor:
        """Return cotangent, (..., rows), times d/d encoded."""

    def jvp(self, residuals: NetworkResiduals, tangent: Tensor) -> Tensor:
        """Return d/d encoded times the encoding's tangent, (..., rows)."""


class Mass(Protocol):
    """What gives M(q) and its derivatives."""

    def prepare(self, definite: bool = True) -> MassPrepared:
        """Return all that depends on the weights alone; ``definite``: keep M positive definite."""

    def forward(self, encoded: Tensor, prepared: MassPrepared) -> tuple[Tensor, MassResiduals]:
        """Return M(q), (..., n, n), and what its derivatives need."""

    def kinetic_vjp(self, encoded: Tensor, qd: Tensor, residuals: MassResiduals) -> Tensor:
        """Return the derivative of 1/2 qd^T M(q) qd by the encoding."""

    def jvp(self, rate: Tensor, residuals: MassResiduals) -> Tensor:
        """Return dM/dt, (..., n, n), where the encoding changes at this rate."""


class Friction(Protocol):
    """What gives D(q, qd)."""

    def prepare(self) -> FrictionPrepared:
        """Return all that depends on the weights alone."""

    def forward(self, encoded: Tensor, qd: Tensor, prepared: FrictionPrepared) -> Tensor:
        """Return D qd, (..., n) [Nm, N]."""

    def dissipation(self, encoded: Tensor, qd: Tensor, prepared: FrictionPrepared) -> Tensor:
        """Return D, (..., n, n)."""
