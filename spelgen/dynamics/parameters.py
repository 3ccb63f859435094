"""Trained parameters of a model: their groups, units and number; copies of a model without residual terms.

`evaluate_with` evaluates a function of a model at given parameters.
"""

import copy
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TypeVar, cast

import torch
from torch import Tensor, nn

from spelgen.dynamics.protocol import residual_terms
from spelgen.runtime.networks import MaskedMLP, MaskedNetwork
from spelgen.runtime.parts import applied
from spelgen.runtime.residual_terms import ResidualDynamics


@dataclass(frozen=True)
class ParameterInfo:
    """Group and unit of a trained parameter of a model. Fits select parameters by group.

    Attributes:
        kind: group of the parameter, one of
            rigid bodies and drives: bodies (inertial parameters), armature, gains (of motors), offset (of torque),
                friction_compensation;
            friction: sizes (viscous and Coulomb coefficients), effects (Stribeck and saturation torques), velocities
                (velocity scales), load_dependence, fractions (of bristles);
            residual terms: torque_splines, torque_ripple, friction_splines, mass_residuals;
            models of networks: mass_constants (constants in M), network (weights and biases);
            position servos: stiffness, damping, dead_zone, delay.
        unit: unit of the physical quantity that the parameter represents, for revolute and for prismatic joints. Most
            parameters are the logarithm of this quantity divided by a nominal value.
    """

    kind: str
    unit: str


NETWORK = ParameterInfo("network", "1")
"""Group and unit of the weights and biases of networks, which no module declares."""


def parameter_table(model: nn.Module) -> dict[str, ParameterInfo]:
    """Return {name: group and unit} of the parameters of a model, and of buffers for which a fit may set a value.

    A quantity is a buffer, and not a parameter, if only some logs determine it: for example, the friction compensation
    of a drive.
    """
    table = {name: NETWORK for name, _ in model.named_parameters()}
    for path, module in model.named_modules():
        # A subclass declares only its additional groups, so the groups of all base classes are collected.
        for declared in type(module).__mro__:
            for name, kind, unit, *_ in vars(declared).get("parameter_groups", ()):
                weight = module._parameters.get(name, module._buffers.get(name))
                # Optional parameters are None or empty in modules that do not use them.
                if weight is not None and weight.numel():
                    table[f"{path}.{name}" if path else name] = ParameterInfo(kind, unit)
    return table


def parameter_count(model: nn.Module) -> int:
    """Return the number of trained parameters of a model."""
    return sum(parameter.numel() for parameter in model.parameters())


def parameters_of_kind(model: nn.Module, *kinds: str) -> tuple[str, ...]:
    """Return the names of the parameters whose group is in ``kinds``, in the order of the model."""
    return tuple(name for name, info in parameter_table(model).items() if info.kind in kinds)


Model = TypeVar("Model", bound=nn.Module)
Result = TypeVar("Result")
NamedTensors = Mapping[str, Tensor]
"""{name of a parameter or buffer of a model: tensor}."""


def idle_residuals(model: object) -> list[str]:
    """Return the names of the parameters of idle residual terms. A term is idle if its value is zero for all q.

    The list is empty for a model without residual terms.
    """
    terms = residual_terms(model)
    if terms is None:
        return []
    # Residual terms of single joints are zero if their parameters are zero. Networks have nonzero hidden layers, so
    # `_is_idle` tests their last layer.
    idle = [name for name, weights in terms.named_parameters(recurse=False) if not weights.any()]
    for prefix, network in (("mass", terms.mass), ("potential", terms.potential)):
        if _is_idle(network):
            idle += [name for name, _ in terms.named_parameters() if name.startswith(f"{prefix}.")]
    return [f"residuals.{name}" for name in idle]


def used_parameter_count(model: nn.Module) -> int:
    """Return the number of parameters of a model, without the parameters of idle residual terms (zero for all q)."""
    idle = idle_residuals(model)
    return sum(weights.numel() for name, weights in model.named_parameters() if name not in idle)


def without_residuals(model: Model) -> Model:
    """Return a copy of the model without residual terms."""
    alone = copy.deepcopy(model)
    if isinstance(alone, ResidualDynamics):
        alone.residuals = None
    return alone


def without_idle_residuals(model: Model) -> Model:
    """Return a copy of the model without residual terms that are zero; the copy takes less time to evaluate.

    The copy must not be trained, since the removed terms could become nonzero in a training.
    """
    # The terms are removed from a copy, since the caller may train the model further.
    reduced = copy.deepcopy(model)
    if isinstance(reduced, ResidualDynamics) and reduced.residuals is not None:
        terms = reduced.residuals
        if _is_idle(terms.mass):
            terms.mass = None
        if _is_idle(terms.potential):
            terms.potential = None
        # If all residual terms are zero, the friction factor is one, and its evaluation is removed, too.
        if not any(bool(weights.any()) for weights in terms.parameters()):
            reduced.residuals = None
    return reduced


def _is_idle(network: MaskedNetwork | None) -> bool:
    """Return True if the output of a network is zero for all inputs, or if there is no network."""
    if not isinstance(network, MaskedMLP):
        return network is None
    # The output is zero if the last layer is zero. Hidden layers are not tested: their initial weights are random.
    return not (network.weights[-1].any() or network.biases[-1].any())


def residual_torque(model: object, q: Tensor, qd: Tensor, qdd: Tensor) -> Tensor:
    """Return the torque of the residual terms of a model, (..., n) [Nm, N]; zeros for a model without them.

    It is the contribution of R(q), which is added to the mass matrix M, and of all terms that are added to the
    potential energy V, including splines and torque ripple. The factor of friction is not included. q, qd, qdd:
    positions [rad, m], velocities [rad/s, m/s] and accelerations [rad/s^2, m/s^2], (..., n).
    """
    if not isinstance(model, ResidualDynamics) or model.residuals is None:
        return torch.zeros_like(q)
    terms = model.residuals
    pose = terms.at(q, model.prepare().residual)
    return applied(pose.mass, qdd) + terms.nonlinear(pose, qd)


def friction_factor(model: object, q: Tensor) -> Tensor:
    """Return the factor by which residual terms multiply the friction of each joint at positions q, (..., n)."""
    if not isinstance(model, ResidualDynamics) or model.residuals is None:
        return torch.ones_like(q)
    return model.residuals.at(q, model.prepare().residual).friction


def evaluate_with(model: Model, parameters: NamedTensors, function: Callable[[Model], Result]) -> Result:
    """Return function(model) at the given parameters, without changing the model.

    The result is differentiable with respect to the given parameters. Parameters that are not given have the values of
    the model.
    """
    # The tensors of the model are replaced while the function is evaluated. `torch.func.functional_call` does the same,
    # but takes longer than most of the functions.
    replaced = []
    for name, tensor in parameters.items():
        path, _, key = name.rpartition(".")
        module = model.get_submodule(path)
        own = module._parameters if key in module._parameters else module._buffers
        tensors = cast("dict[str, Tensor]", own)
        replaced.append((tensors, key, tensors[key]))
        tensors[key] = tensor
    try:
        return function(model)
    finally:
        for tensors, key, tensor in replaced:
            tensors[key] = tensor
