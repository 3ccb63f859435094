"""What stands beside the rigid bodies of a model, and the model without it."""

from __future__ import annotations

import copy
from typing import Any


def idle_residuals(model: Any) -> list[str]:
    """The names of a model's parameters of residuals that add nothing to it as it is."""
    dynamics = model.dynamics
    if not hasattr(dynamics, "residual_mass"):
        return []
    parts = [("joint_functions.", dynamics.joint_functions), ("residual_mass.", dynamics.residual_mass)]
    idle = [
        f"dynamics.{part}{name}"
        for part, module in parts
        for name, x in module.named_parameters(recurse=False)
        if not x.any()
    ]
    for part in ("residual_mass", "residual_potential"):
        network = getattr(getattr(dynamics, part), "network", None)
        if network is not None and _idle(network):
            idle += [f"dynamics.{part}.network.{name}" for name, _ in network.named_parameters()]
    return idle


def without_residuals(dynamics: Any) -> Any:
    """The rigid bodies alone, of the same weights."""
    found = copy.copy(dynamics)
    if hasattr(dynamics, "residual_mass"):
        # an emitted module brings its own classes: that of bodies alone is the base of the one with residuals
        found.__class__ = type(dynamics).__base__
    return found


def without_idle_residuals(dynamics: Any) -> Any:
    """The same without residuals that give nothing, for weights that change no more; networks are taken from it."""
    if not hasattr(dynamics, "residual_mass"):
        return dynamics
    mass, potential = dynamics.residual_mass, dynamics.residual_potential
    if potential is not None and _idle(potential.network):
        dynamics.residual_potential = None
    if mass.network is not None and _idle(mass.network):
        mass.network = None
    rest = [mass.raw_constants, *dynamics.joint_functions.parameters()]
    used = mass.network is not None or dynamics.residual_potential is not None
    return dynamics if used or any(bool(each.any()) for each in rest) else without_residuals(dynamics)


def _idle(network: Any) -> bool:
    return not any(bool(layers[-1].any()) for layers in (network.weights, network.biases))
