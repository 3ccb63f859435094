"""Fit a model of networks to torques: L-BFGS on the error of its inverse dynamics, all samples at once."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch

from spelgen.identification.samples import DynamicsSamples
from spelgen.training.descent import WholeSet

if TYPE_CHECKING:
    from spelgen.training.runs import EmittedModel

CALL, MOST = 20, 2000  # evaluations: between looks at whether more would help, and in all


@dataclass(frozen=True, eq=False)
class _Columns:
    """All samples, each (T, n)."""

    q: torch.Tensor
    qd: torch.Tensor
    qdd: torch.Tensor
    tau: torch.Tensor


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
    columns = _Columns(
        *(
            torch.from_numpy(np.concatenate([getattr(x, name) for x in samples]))
            for name in _Columns.__annotations__
        )
    )
    scale = columns.tau.std(dim=0)
    scale = torch.maximum(scale, 1e-2 * scale.amax())

    def missed(at: _Columns) -> torch.Tensor:
        torque = model.inverse_dynamics(at.q, at.qd, at.qdd)
        return ((torque - at.tau) / scale).square().mean() + pull()

    descent = WholeSet(model, decay)
    evaluations = 0
    while evaluations < MOST and not descent.stalled:
        descent.descend(missed, columns, CALL, lambda _: 1.0)
        evaluations += CALL
    return evaluations
