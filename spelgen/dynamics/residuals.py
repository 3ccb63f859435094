"""What stands beside the rigid bodies of a model, and the model without it."""

from __future__ import annotations

import copy
from typing import Any

import torch
from torch import Tensor

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
    networks = {
        "residual_mass.network": model.residual_mass.network,
        "residual_potential": model.residual_potential,
    }
    for owner, network in networks.items():
        if network is not None and _is_idle(network):
            idle += [f"{owner}.{name}" for name, _ in network.named_parameters()]
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
    potential_is_idle = potential is None or _is_idle(potential)
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


def residual_torque(model: Any, q: Tensor, qd: Tensor, qdd: Tensor) -> Tensor:
    """Return the torque (..., n) [Nm, N] that residuals of M and V take; zero without any."""
    if not has_residuals(model):
        return torch.zeros_like(q)
    torque: Tensor = model.residual_torque(q, qd, qdd, model.prepare())
    return torque


def friction_factor(model: Any, q: Tensor) -> Tensor:
    """Return how much more friction (..., n) the drives have at q than their laws say; one without residuals."""
    if not has_residuals(model):
        return torch.ones_like(q)
    functions = model.joint_functions
    factor: Tensor = functions.forward(q, functions.prepare())[1]
    return factor
