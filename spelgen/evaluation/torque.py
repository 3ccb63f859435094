"""Torque errors of inverse dynamics on measured trajectories, by one protocol: comparable figures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from spelgen.identification.samples import DynamicsSamples


@dataclass(frozen=True)
class TorqueErrors:
    """Errors of one predictor: nmse and rmse per trajectory and joint, (trajectories, n).

    nmse: mean squared error / variance of the torque, NaN where the torque never varies. rmse: [Nm, N].
    """

    trajectories: tuple[str, ...]
    nmse: np.ndarray
    rmse: np.ndarray


def torque_errors(
    torque: Callable[..., torch.Tensor],
    samples: Sequence[DynamicsSamples],
) -> TorqueErrors:
    """Errors of an inverse dynamics on these samples; it is given q, qd, qdd and, where known, z."""
    nmse, rmse = [], []
    for sample in samples:
        with torch.no_grad():
            known = (x for x in (sample.q, sample.qd, sample.qdd, sample.z) if x is not None)
            found = torque(*map(torch.from_numpy, known))
            squares = (found - torch.from_numpy(sample.tau)).square().mean(dim=0).numpy()
        variance = sample.tau.var(axis=0)
        nmse.append(np.divide(squares, variance, out=np.full_like(squares, np.nan), where=variance > 0))
        rmse.append(np.sqrt(squares))
    return TorqueErrors(tuple(x.name for x in samples), np.array(nmse), np.array(rmse))
