"""Torque errors of inverse dynamics on measured trajectories, by one protocol: comparable figures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from spelgen.identification.samples import dynamics_samples
from spelgen.logs.read import Trajectory


@dataclass(frozen=True)
class TorqueErrors:
    """Errors of one contender: nmse and rmse per trajectory and joint, (trajectories, n).

    nmse: mean squared error / variance of the torque, NaN where the torque never varies. rmse: [Nm, N].
    """

    trajectories: tuple[str, ...]
    nmse: np.ndarray
    rmse: np.ndarray


@dataclass(frozen=True, eq=False)
class TorqueSamples:
    """Samples (T, n) of one trajectory on which inverse dynamics is judged."""

    name: str
    q: torch.Tensor
    qd: torch.Tensor
    qdd: torch.Tensor
    tau: torch.Tensor


def torque_samples(trajectories: Sequence[Trajectory]) -> list[TorqueSamples]:
    """The moving samples of each dense enough trajectory, by the protocol of ``dynamics_samples``."""
    return [
        TorqueSamples(x.name, *(torch.from_numpy(part) for part in (x.q, x.qd, x.qdd, x.tau)))
        for x in dynamics_samples(trajectories)
    ]


def torque_errors(
    torque: Callable[[torch.Tensor, torch.Tensor, torch.Tensor], torch.Tensor],
    samples: Sequence[TorqueSamples],
) -> TorqueErrors:
    """Errors of an inverse dynamics on these samples."""
    nmse, rmse = [], []
    for sample in samples:
        with torch.no_grad():
            squares = (torque(sample.q, sample.qd, sample.qdd) - sample.tau).square().mean(dim=0).numpy()
        variance = sample.tau.var(dim=0, correction=0).numpy()
        nmse.append(np.divide(squares, variance, out=np.full_like(squares, np.nan), where=variance > 0))
        rmse.append(np.sqrt(squares))
    return TorqueErrors(tuple(x.name for x in samples), np.array(nmse), np.array(rmse))
