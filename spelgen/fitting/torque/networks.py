"""Fit of a model of networks to torques: L-BFGS on the error of its inverse dynamics, on all samples at once."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

import torch

from spelgen.fitting.optimizers import minimise
from spelgen.fitting.torque.samples import TorqueSamples
from spelgen.settings.fits import DEFAULTS, Adaptation

if TYPE_CHECKING:
    from spelgen.emission.assemble import ArmModel

ADAPTED_PARTS: dict[Adaptation, tuple[str, ...]] = {
    "load": ("mass.", "potential."),
    "friction": ("friction.",),
    "unit": ("",),
}
"""Prefixes of the names of the weights that an adaptation fits."""
BLOCK = 2**16  # samples in memory at a time, with the intermediate results that their gradient needs


def fit_networks(
    model: ArmModel,
    samples: TorqueSamples,
    weight_decay: float = DEFAULTS.lbfgs_decay,
    penalty: Callable[[], torch.Tensor | float] | None = None,
    evaluations: int = 2000,
) -> int:
    """Minimize the mean squared torque error of a model over its weights; return the number of evaluations.

    Args:
        model: its weights that require a gradient are fitted.
        samples: torques as logged, (T, n) [Nm, N]; errors are divided by the standard deviation of each joint's torque.
        weight_decay: see `LBFGS`.
        penalty: is added to the loss, for example the distance from a URDF.
        evaluations: maximum number of evaluations of the loss.
    """
    count, joints = samples.columns.tau.shape
    scale = samples.columns.tau.std(dim=0)
    scale = torch.maximum(scale, 1e-2 * scale.amax())

    def summands() -> Iterator[torch.Tensor]:
        for number, (q, qd, qdd, tau, *_) in enumerate(samples.blocks(BLOCK)):
            error = ((model.inverse_dynamics(q, qd, qdd) - tau) / scale).square()
            cost = error.mean() if count <= BLOCK else error.sum() / (count * joints)
            if number == 0 and penalty is not None:
                cost = cost + penalty()
            yield cost

    return minimise(model, summands, evaluations, weight_decay)


def adapt_networks(
    model: ArmModel,
    samples: TorqueSamples,
    adapt: Adaptation,
    weight_decay: float = DEFAULTS.lbfgs_decay,
    evaluations: int = 2000,
) -> int:
    """Fit a part of a fitted model to further samples; return the number of evaluations.

    Args:
        model: fitted model.
        samples: torques as logged, (T, n) [Nm, N].
        adapt: part of the model, see `ADAPTED_PARTS`.
        weight_decay: factor of half the squared change of the weights, which is added to the loss: weights that these
            samples do not determine are unchanged.
        evaluations: maximum number of evaluations of the loss.
    """
    fitted = {name: x for name, x in model.named_parameters() if name.startswith(ADAPTED_PARTS[adapt])}
    initial = {name: x.detach().clone() for name, x in fitted.items()}

    def penalty() -> torch.Tensor | float:
        return weight_decay / 2 * sum((x - initial[name]).square().sum() for name, x in fitted.items())

    try:
        for name, parameter in model.named_parameters():
            parameter.requires_grad_(name in fitted)
        return fit_networks(model, samples, 0.0, penalty, evaluations)
    finally:
        model.requires_grad_(True)
