"""Fit a model of networks to torques: L-BFGS on the error of its inverse dynamics, all samples at once."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch

from spelgen.fitting.optimizers import minimise
from spelgen.identification.samples import DynamicsSamples

if TYPE_CHECKING:
    from spelgen.fitting.run_folder import EmittedModel

MOST = 2000  # evaluations


def fit_networks(
    model: EmittedModel,
    samples: Sequence[DynamicsSamples],
    decay: float,
    pull: Callable[[], torch.Tensor | float] = lambda: 0.0,
) -> int:
    """Set the weights of ``model`` to what meets the samples' torques best; return the evaluations it took.

    The error of each joint is told in standard deviations of its torque. decay: see ``WholeSet``; pull: what else
    is to be small, the distance from a URDF for one.
    """
    q, qd, qdd, tau = (
        torch.from_numpy(np.concatenate([getattr(x, name) for x in samples]))
        for name in ("q", "qd", "qdd", "tau")
    )  # each (T, n)
    scale = tau.std(dim=0)
    scale = torch.maximum(scale, 1e-2 * scale.amax())

    def missed() -> torch.Tensor:
        return ((model.inverse_dynamics(q, qd, qdd) - tau) / scale).square().mean() + pull()

    return minimise(model, missed, MOST, decay)
