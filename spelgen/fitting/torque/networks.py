"""Fit a model of networks to torques: L-BFGS on the error of its inverse dynamics, all samples at once."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

import torch

from spelgen.fitting.optimizers import minimise
from spelgen.fitting.torque.samples import TorqueSamples
from spelgen.settings.fits import DEFAULTS, Adaptation

if TYPE_CHECKING:
    from spelgen.emission.assemble import ArmModel

MOVING: dict[Adaptation, tuple[str, ...]] = {
    "load": ("mass.", "potential."),
    "friction": ("friction.",),
    "unit": ("",),
}
"""How the names of weights begin that an adaptation moves."""
BLOCK = 2**16  # samples in memory with all that their gradient needs


def fit_networks(
    model: ArmModel,
    samples: TorqueSamples,
    weight_decay: float = DEFAULTS.lbfgs_decay,
    penalty: Callable[[], torch.Tensor | float] | None = None,
    evaluations: int = 2000,
) -> int:
    """Set the weights of ``model`` to what meets the samples' torques best; return the evaluations it took.

    The error of each joint is told in standard deviations of its torque. weight_decay: see ``LBFGS``; penalty: what
    else is to be small, the distance from a URDF for one.
    """
    count, joints = samples.columns.tau.shape
    scale = samples.columns.tau.std(dim=0)
    scale = torch.maximum(scale, 1e-2 * scale.amax())

    def missed() -> Iterator[torch.Tensor]:
        for number, (q, qd, qdd, tau, *_) in enumerate(samples.blocks(BLOCK)):
            error = ((model.inverse_dynamics(q, qd, qdd) - tau) / scale).square()
            cost = error.mean() if count <= BLOCK else error.sum() / (count * joints)
            if number == 0 and penalty is not None:
                cost = cost + penalty()
            yield cost

    return minimise(model, missed, evaluations, weight_decay)


def adapt_networks(
    model: ArmModel,
    samples: TorqueSamples,
    adapt: Adaptation,
    weight_decay: float = DEFAULTS.lbfgs_decay,
    evaluations: int = 2000,
) -> int:
    """Move a part of a fitted model to what meets the samples' torques best; return the evaluations it took.

    weight_decay: of half the sum of squared changes, so that what these samples do not show stays as it was.
    """
    moving = {name: x for name, x in model.named_parameters() if name.startswith(MOVING[adapt])}
    start = {name: x.detach().clone() for name, x in moving.items()}

    def changed() -> torch.Tensor | float:
        return weight_decay / 2 * sum((x - start[name]).square().sum() for name, x in moving.items())

    try:
        for name, parameter in model.named_parameters():
            parameter.requires_grad_(name in moving)
        return fit_networks(model, samples, 0.0, changed, evaluations)
    finally:
        model.requires_grad_(True)
