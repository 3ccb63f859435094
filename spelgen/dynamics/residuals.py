"""Residual terms of a model, and the model without them."""

from __future__ import annotations

import copy
from typing import TypeVar

import torch
from torch import Tensor, nn

from spelgen.dynamics.protocol import residual_terms
from spelgen.runtime.masked_mlp import MaskedMLP
from spelgen.runtime.parts import Network
from spelgen.runtime.residual_dynamics import ResidualDynamics

Model = TypeVar("Model")


def idle_residuals(model: object) -> list[str]:
    """Return the names of the parameters of residual terms that are zero."""
    terms = residual_terms(model)
    if terms is None:
        return []
    idle = [name for name, weights in terms.named_parameters(recurse=False) if not weights.any()]
    for part, network in (("mass", terms.mass), ("potential", terms.potential)):
        if _is_idle(network):
            idle += [name for name, _ in terms.named_parameters() if name.startswith(f"{part}.")]
    return [f"residuals.{name}" for name in idle]


def used_parameter_count(model: nn.Module) -> int:
    """Return the number of parameters of a model, without those of residual terms that are zero."""
    idle = idle_residuals(model)
    return sum(weights.numel() for name, weights in model.named_parameters() if name not in idle)


def without_residuals(model: Model) -> Model:
    """Return a copy of the model without residual terms."""
    alone = copy.deepcopy(model)
    if isinstance(alone, ResidualDynamics):
        alone.residuals = None
    return alone


def without_idle_residuals(model: Model) -> Model:
    """Return a copy of the model without residual terms that are zero, for constant parameters."""
    reduced = copy.deepcopy(model)
    if isinstance(reduced, ResidualDynamics) and reduced.residuals is not None:
        terms = reduced.residuals
        terms.mass = None if _is_idle(terms.mass) else terms.mass
        terms.potential = None if _is_idle(terms.potential) else terms.potential
        if not any(bool(weights.any()) for weights in terms.parameters()):
            reduced.residuals = None
    return reduced


def _is_idle(network: Network | None) -> bool:
    """Return whether a network is zero for all inputs; a network that does not exist is."""
    if not isinstance(network, MaskedMLP):
        return network is None
    return not (network.weights[-1].any() or network.biases[-1].any())


def residual_torque(model: object, q: Tensor, qd: Tensor, qdd: Tensor) -> Tensor:
    """Return the torque (..., n) [Nm, N] of the residual terms of M and V at q, qd, qdd (..., n)."""
    if not isinstance(model, ResidualDynamics) or model.residuals is None:
        return torch.zeros_like(q)
    terms = model.residuals
    pose = terms.at(q, model.prepare().residual)
    torque: Tensor = (pose.mass @ qdd.unsqueeze(-1)).squeeze(-1) + terms.nonlinear(pose, qd)
    return torque


def friction_factor(model: object, q: Tensor) -> Tensor:
    """Return the factor of the residual terms on friction, (..., n), at q (..., n)."""
    if not isinstance(model, ResidualDynamics) or model.residuals is None:
        return torch.ones_like(q)
    factor: Tensor = model.residuals.at(q, model.prepare().residual).friction
    return factor
