"""What stands beside rigid bodies and has not entered: all its weights, which a fit to windows lets rest at first."""

from __future__ import annotations

from typing import Any


def idle_residuals(model: Any) -> list[str]:
    """The names of the parameters of residuals that add nothing to the model as it is."""
    dynamics, prefix = model.dynamics, "dynamics."
    functions = getattr(dynamics, "joint_functions", None)
    if functions is None:
        return []
    idle = [f"{prefix}joint_functions.{name}" for name, x in functions.named_parameters() if not x.any()]
    for part in ("residual_mass", "residual_potential"):
        module = getattr(dynamics, part)
        if module is not None and not _adds(module):
            idle += [f"{prefix}{part}.{name}" for name, _ in module.named_parameters()]
    return idle


def _adds(module: Any) -> bool:
    """Whether a network's last layer, or a constant, differs from zero."""
    named = dict(module.named_parameters())
    network = module.network
    last = len(network.weights) - 1 if network is not None else 0
    ends = ("raw_constants", f"network.weights.{last}", f"network.biases.{last}")
    return any(bool(named[name].any()) for name in ends if name in named)
