"""Whether a model of rigid bodies has anything beside them, and what it is without that."""

from __future__ import annotations

import copy
from typing import Any


def has_residuals(dynamics: Any) -> bool:
    """Whether something that is not zero stands beside rigid bodies."""
    if not hasattr(dynamics, "residual_mass"):
        return False
    parts = (dynamics.residual_mass, dynamics.residual_potential)
    networks = [part.network for part in parts if part is not None and part.network is not None]
    weights = [
        dynamics.residual_mass.raw_constants,
        *dynamics.joint_functions.parameters(),
        *(layers[-1] for network in networks for layers in (network.weights, network.biases)),
    ]
    return any(bool(each.any()) for each in weights)


def without_residuals(dynamics: Any) -> Any:
    """The rigid bodies alone, of the same weights."""
    found = copy.copy(dynamics)
    if hasattr(dynamics, "residual_mass"):
        # an emitted module brings its own classes: that of bodies alone is known as the base of the one with residuals
        found.__class__ = type(dynamics).__base__
    return found
