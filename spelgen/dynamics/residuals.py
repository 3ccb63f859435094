"""What stands beside the rigid bodies of a model, and the model without it."""

from __future__ import annotations

import copy
from typing import TypeVar

import torch
from torch import Tensor, nn

from spelgen.dynamics.protocol import residual_terms
from spelgen.runtime.masked_mlp import MaskedMLP
from spelgen.runtime.residual_dynamics import ResidualDynamics

Model = TypeVar("Model")

NETWORKS = ("mass", "potential")  # of residual terms, by attribute


def idle_residuals(model: object) -> list[str]:
    """Return the names of a model's parameters of residuals that add nothing to it as it is."""
    terms = residual_terms(model)
    if terms is None:
        return []
    idle = [name for name, weights in terms.named_parameters(recurse=False) if not weights.any()]
    for part in NETWORKS:
        if _is_idle(getattr(terms, part)):
            idle += [name for name, _ in terms.named_parameters() if name.startswith(f"{part}.")]
    return [f"residuals.{name}" for name in idle]


def used_parameter_count(model: nn.Module) -> int:
    """Return how many numbers make a model: those of residuals that add nothing do not count."""
    idle = idle_residuals(model)
    return sum(weights.numel() for name, weights in model.named_parameters() if name not in idle)


def without_residuals(model: Model) -> Model:
    """Return a copy of the model that is its rigid bodies alone."""
    alone = copy.deepcopy(model)
    if isinstance(alone, ResidualDynamics):
        alone.residuals = None
    return alone


def without_idle_residuals(model: Model) -> Model:
    """Return a copy of the model without residuals that give nothing, for weights that change no more."""
    reduced = copy.deepcopy(model)
    if isinstance(reduced, ResidualDynamics) and reduced.residuals is not None:
        terms = reduced.residuals
        for part in NETWORKS:
            if _is_idle(getattr(terms, part)):
                setattr(terms, part, None)
        if not any(bool(weights.any()) for weights in terms.parameters()):
            reduced.residuals = None
    return reduced


def _is_idle(network: MaskedMLP | None) -> bool:
    """Return whether a network gives zero for all inputs, as none at all does."""
    return network is None or not (network.weights[-1].any() or network.biases[-1].any())


def residual_torque(model: object, q: Tensor, qd: Tensor, qdd: Tensor) -> Tensor:
    """Return the torque (..., n) [Nm, N] that residuals of M and V take; zero without any."""
    if not isinstance(model, ResidualDynamics) or model.residuals is None:
        return torch.zeros_like(q)
    terms = model.residuals
    pose = terms.at(q, model.prepare().residual)
    torque: Tensor = (pose.mass @ qdd.unsqueeze(-1)).squeeze(-1) + terms.nonlinear(pose, qd)
    return torque


def friction_factor(model: object, q: Tensor) -> Tensor:
    """Return how much more friction (..., n) the drives have at q than their laws say; one without residuals."""
    if not isinstance(model, ResidualDynamics) or model.residuals is None:
        return torch.ones_like(q)
    factor: Tensor = model.residuals.at(q, model.prepare().residual).friction
    return factor
