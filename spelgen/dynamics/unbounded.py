"""M as its network gives it, without what keeps it positive definite."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from torch import Tensor, nn


class Unbounded(nn.Module):
    """Stands in for a PositiveDefiniteBound towards ``center``: all of M as it comes."""

    def __init__(self, center: Tensor) -> None:
        super().__init__()
        self.center = nn.Buffer(center)

    def forward(self, mass: Tensor) -> tuple[Tensor, Tensor]:
        """Return M, and the fraction of its changes that is taken: one."""
        return mass, mass.new_ones(mass.shape[:-2])


@contextmanager
def mass_as_learned(model: nn.Module) -> Iterator[None]:
    """Let the model's M be indefinite where its network says so; a model that bounds nothing stays as it is."""
    mass = getattr(model, "mass", None)
    bound = getattr(mass, "bound", None)
    if mass is None or bound is None:
        yield
        return
    mass.bound = Unbounded(bound.center)
    try:
        yield
    finally:
        mass.bound = bound
