"""Torque errors of inverse dynamics on measured trajectories, by one protocol: comparable figures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from spelgen.data.logs import Trajectory
from spelgen.data.signals import low_pass, resample
from spelgen.data.trajectory import rate, split_at_gaps

FREQUENCY = 100.0  # [Hz] of the common grid
CUTOFF = 8.0  # [Hz]
MOVING = 0.02  # [rad/s, m/s] samples at which every joint is slower say nothing of dynamics
DENSE = 50.0  # [Hz] below this rate accelerations cannot be had from a log
SHORTEST = 1.0  # [s] pieces below this are all filter transient


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
    """The moving samples of each dense enough trajectory.

    Resampled to 100 Hz, zero-phase 4th-order Butterworth low-pass at 8 Hz on q, qd and tau, qdd by central
    differences of the filtered qd, only samples with some |qd| > 0.02 rad/s; pieces between gaps separately.
    """
    return [_samples(x) for x in trajectories if rate(x) >= DENSE and any(map(_long, split_at_gaps(x)))]


def _long(piece: Trajectory) -> bool:
    return bool(piece.t[-1] - piece.t[0] >= SHORTEST)


def _samples(trajectory: Trajectory) -> TorqueSamples:
    parts = []
    for piece in filter(_long, split_at_gaps(trajectory)):
        smooth = low_pass(resample(piece, FREQUENCY), CUTOFF)
        qdd = np.gradient(smooth.qd, smooth.t, axis=0)
        moving = (np.abs(smooth.qd) > MOVING).any(axis=1)
        parts.append([x[moving] for x in (smooth.q, smooth.qd, qdd, smooth.tau)])
    q, qd, qdd, tau = (torch.from_numpy(np.concatenate(columns)) for columns in zip(*parts, strict=True))
    return TorqueSamples(trajectory.name, q, qd, qdd, tau)


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
