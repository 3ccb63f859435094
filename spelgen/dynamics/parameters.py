"""The meaning of each trained parameter of a model, as the parts of the runtime declare it."""

from __future__ import annotations

from dataclasses import dataclass

from torch import nn


@dataclass(frozen=True)
class ParameterInfo:
    """The group and the unit of a parameter.

    kind: bodies, armature, gains, offset, friction_compensation, sizes (magnitude of friction), effects (friction that
    varies with velocity), velocities, load_dependence, fractions (of bristles), torque_splines, torque_ripple,
    friction_splines, mass_constants, mass_residuals, stiffness, damping,
    dead_zone, delay, or network. unit: of the quantity that the parameter makes, of revolute and of prismatic joints;
    most parameters are logarithms of it, relative to a nominal value.
    """

    kind: str
    unit: str


NETWORK = ParameterInfo("network", "1")
"""Weights and biases, which no part declares."""


def parameter_table(model: nn.Module) -> dict[str, ParameterInfo]:
    """Return the meaning of the parameters of a model, by name, and of the buffers that a fit may set.

    Such buffers are those that a part declares: quantities that only some logs determine, as a friction compensation.
    """
    table = {name: NETWORK for name, _ in model.named_parameters()}
    for path, module in model.named_modules():
        for declared in type(module).__mro__:
            for name, kind, unit, *_ in vars(declared).get("parameter_groups", ()):
                weight = module._parameters.get(name, module._buffers.get(name))
                if weight is not None and weight.numel():  # a part may have none
                    table[f"{path}.{name}" if path else name] = ParameterInfo(kind, unit)
    return table


def parameter_count(model: nn.Module) -> int:
    """Return the number of trained parameters of a model."""
    return sum(parameter.numel() for parameter in model.parameters())


def parameters_of_kind(model: nn.Module, *kinds: str) -> tuple[str, ...]:
    """Return the names of the parameters of these groups, in the order of the model."""
    return tuple(name for name, info in parameter_table(model).items() if info.kind in kinds)
