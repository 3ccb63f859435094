"""M as its network gives it, without what keeps it positive definite."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from torch import Tensor, nn


def unbounded(mass: Tensor) -> Tensor:
    """Return one for every matrix: all of M's changes stand, see ``DerivedMass.fraction``."""
    return mass.new_ones(mass.shape[:-2])


@contextmanager
def mass_as_learned(model: nn.Module) -> Iterator[None]:
    """Let the model's M be indefinite where its network says so; a model that bounds nothing stays as it is."""
    mass = getattr(model, "mass", None)
    if mass is None or not hasattr(mass, "fraction"):
        yield
        return
    mass.fraction = unbounded
    try:
        yield
    finally:
        del mass.fraction
