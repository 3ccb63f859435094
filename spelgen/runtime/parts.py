"""What a model needs of its parts; an emitted module has the class of its own part under each of these names."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol

from torch import Tensor

Row = Sequence[float]
Rows = Sequence[Sequence[float]]
Pairs = Sequence[tuple[float, float]]
Layout = Callable[[Sequence[Tensor], Sequence[Tensor]], Tensor]  # a matrix by functions and constants
Units = Sequence[tuple[tuple[int, ...], int]]  # of a layer: which joints so many units may read
Layers = tuple[tuple[Tensor, Tensor], ...]  # a network's weights and biases, ready for many states
Intermediates = Any  # what a part's derivatives need of the work done for its values
Prepared = Any  # all that depends on the weights alone
# an emitted module has the type of its own dynamics under this name
Pose = Any  # all that depends on q alone


class Network(Protocol):
    """Learned functions y of an encoding, each of its own joints, with derivatives written out."""

    def prepare(self, output_map: Tensor, offset: Tensor) -> Layers:
        """Return the weights made ready for many states, for offset + output_map y in place of y."""

    def forward(self, encoded: Tensor, layers: Layers) -> tuple[Tensor, Intermediates]:
        """Return offset + output_map y, (..., rows), and intermediates, which ``vjp`` and ``jvp`` need."""

    def vjp(self, intermediates: Intermediates, cotangent: Tensor) -> Tensor:
        """Return cotangent, (..., rows), times d/d encoded."""

    def jvp(self, intermediates: Intermediates, tangent: Tensor) -> Tensor:
        """Return d/d encoded times the encoding's tangent, (..., rows)."""


class Mass(Protocol):
    """What gives M(q) and its derivatives."""

    def prepare(self) -> Prepared:
        """Return all that depends on the weights alone."""

    def forward(self, encoded: Tensor, prepared: Prepared) -> tuple[Tensor, Intermediates]:
        """Return M(q), (..., n, n), and what its derivatives need."""

    def kinetic_vjp(self, qd: Tensor, intermediates: Intermediates) -> Tensor:
        """Return the derivative of 1/2 qd^T M(q) qd by the encoding."""

    def jvp(self, rate: Tensor, intermediates: Intermediates) -> Tensor:
        """Return dM/dt, (..., n, n), where the encoding changes at this rate."""


class Friction(Protocol):
    """What gives D(q, qd)."""

    def prepare(self) -> Prepared:
        """Return all that depends on the weights alone."""

    def forward(self, encoded: Tensor, qd: Tensor, prepared: Prepared, right: Tensor) -> Tensor:
        """Return D(q, qd) right, (..., n, k)."""
