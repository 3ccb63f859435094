"""What stands beside the rigid bodies of a model, and the model without it."""

from __future__ import annotations

import copy
from typing import Any

from spelgen.dynamics.protocol import has_residuals


def idle_residuals(model: Any) -> list[str]:
    """Return the names of a model's parameters of residuals that add nothing to it as it is."""
    if not has_residuals(model):
        return []
    modules = [("joint_functions", model.joint_functions), ("residual_mass", model.residual_mass)]
    idle = [
        f"{owner}.{name}"
        for owner, module in modules
        for name, x in module.named_parameters(recurse=False)
        if not x.any()
    ]
    for owner in ("residual_mass", "residual_potential"):
        network = getattr(getattr(model, owner), "network", None)
        if network is not None and _is_idle(network):
            idle += [f"{owner}.network.{name}" for name, _ in network.named_parameters()]
    return idle


def without_residuals(model: Any) -> Any:
    """Return a copy of the model that is its rigid bodies alone."""
    alone = copy.deepcopy(model)
    if has_residuals(alone):
        alone.joint_functions = alone.residual_mass = alone.residual_potential = None
    return alone


def without_idle_residuals(model: Any) -> Any:
    """Return a copy of the model without residuals that give nothing, for weights that change no more."""
    if not has_residuals(model):
        return copy.deepcopy(model)
    mass, potential, functions = model.residual_mass, model.residual_potential, model.joint_functions
    mass_is_idle = mass.network is None or _is_idle(mass.network)
    potential_is_idle = potential is None or _is_idle(potential.network)
    weights = [mass.raw_constants, *functions.parameters()]
    if mass_is_idle and potential_is_idle and not any(bool(x.any()) for x in weights):
        return without_residuals(model)
    reduced = copy.deepcopy(model)
    if mass_is_idle:
        reduced.residual_mass.network = None
    if potential_is_idle:
        reduced.residual_potential = None
    return reduced


def _is_idle(network: Any) -> bool:
    return not any(bool(layers[-1].any()) for layers in (network.weights, network.biases))
