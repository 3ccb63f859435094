"""What a model needs of its parts."""

from __future__ import annotations

from typing import Any, Protocol

from torch import Tensor


class Mass(Protocol):
    """What gives M(q) and its derivatives."""

    def prepare(self, definite: bool = True) -> Any:
        """All that depends on the weights alone; ``definite``: keep M positive definite."""

    def __call__(self, encoded: Tensor, prepared: Any) -> tuple[Tensor, Any]:
        """M(q), (..., n, n), and what its derivatives need."""

    def kinetic_vjp(self, encoded: Tensor, qd: Tensor, residuals: Any) -> Tensor:
        """The derivative of 1/2 qd^T M(q) qd by the encoding."""

    def jvp(self, rate: Tensor, residuals: Any) -> Tensor:
        """dM/dt, (..., n, n), where the encoding changes at this rate."""


class Friction(Protocol):
    """What gives D(q, qd)."""

    def prepare(self) -> Any:
        """All that depends on the weights alone."""

    def __call__(self, encoded: Tensor, qd: Tensor, prepared: Any) -> Tensor:
        """D qd, (..., n) [Nm, N]."""

    def dissipation(self, encoded: Tensor, qd: Tensor, prepared: Any) -> Tensor:
        """D, (..., n, n)."""


class Input(Protocol):
    """What gives G."""

    def prepare(self) -> Any:
        """All that depends on the weights alone."""

    def __call__(self, encoded: Tensor, prepared: Any) -> Tensor:
        """G, (..., n, n)."""

    def force(self, encoded: Tensor, tau: Tensor, prepared: Any) -> Tensor:
        """G tau, (..., n)."""

    def solve(self, encoded: Tensor, force: Tensor, prepared: Any) -> Tensor:
        """The inputs, (..., n), that make this force."""


class DriveInput(Input, Protocol):
    """What gives a constant G, and how the drives turn."""

    def motor_speeds(self) -> Tensor:
        """C, (n, n): the drives' speeds are C qd."""
