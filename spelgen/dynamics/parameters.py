"""What each trained number of a model stands for, as the parts of the runtime declare it."""

from __future__ import annotations

from dataclasses import dataclass

from torch import nn


@dataclass(frozen=True)
class ParameterInfo:
    """A parameter by what it stands for, whichever part of a model holds it.

    kind: bodies, armature, gains, offset, friction_compensation, sizes (of friction), effects (sizes of what varies it
    with velocity), velocities, load_dependence, fractions (of bristles), torque_splines, torque_ripple,
    friction_splines, mass_constants, mass_residuals, stiffness, damping,
    dead_zone, delay, or network. unit: of the quantity that the parameter makes, of revolute and of prismatic joints;
    most parameters are logarithms of it, relative to a nominal value.
    """

    kind: str
    unit: str


NETWORK = ParameterInfo("network", "1")
"""Of all parameters that no part declares: weights and biases."""


def parameter_table(model: nn.Module) -> dict[str, ParameterInfo]:
    """Return, by name, what a model's parameters stand for, and the buffers that a fit may set.

    Buffers are those that a part declares: what only some logs can tell, such as a friction compensation.
    """
    table = {name: NETWORK for name, _ in model.named_parameters()}
    for path, module in model.named_modules():
        for declared in type(module).__mro__:
            for name, kind, unit, *_ in vars(declared).get("kinds", ()):
                weight = getattr(module, name)
                if weight is not None and weight.numel():  # a part may do without
                    table[f"{path}.{name}" if path else name] = ParameterInfo(kind, unit)
    return table


def parameter_count(model: nn.Module) -> int:
    """Return how many numbers of a model are trained."""
    return sum(parameter.numel() for parameter in model.parameters())


def parameters_of_kind(model: nn.Module, *kinds: str) -> tuple[str, ...]:
    """Return the names of a model's parameters of these kinds, in its own order."""
    return tuple(name for name, info in parameter_table(model).items() if info.kind in kinds)
