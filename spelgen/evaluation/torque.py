"""Torque errors of inverse dynamics on measured trajectories, by one protocol: comparable figures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from spelgen.dynamics.protocol import known_past
from spelgen.evaluation.plain import finite
from spelgen.logs.dynamics_samples import DynamicsSamples


@dataclass(frozen=True)
class TorqueErrors:
    """Errors of one predictor: nmse and rmse per trajectory and joint, (trajectories, n).

    nmse: mean squared error / variance of the torque, NaN where the torque never varies. rmse: [Nm, N].
    """

    trajectories: tuple[str, ...]
    nmse: np.ndarray
    rmse: np.ndarray

    def summary(self) -> TorqueSummary:
        """Return means over joints and trajectories."""
        # a joint whose torque never varies has no nMSE, and says nothing
        by_trajectory = np.nanmean(self.nmse, axis=1)
        nmse = dict(zip(self.trajectories, finite(by_trajectory), strict=True))
        (mean,) = finite(by_trajectory.mean(keepdims=True))
        by_joint = finite(np.nanmean(self.nmse, axis=0))
        return TorqueSummary(nmse, mean, finite(self.rmse.mean(axis=0)), by_joint)


@dataclass(frozen=True)
class TorqueSummary:
    """Errors of the inverse dynamics of one predictor by the protocol of `dynamics_samples`.

    nmse: per trajectory, mean over joints. mean_nmse: mean over trajectories. rmse [Nm, N], joint_nmse: per
    joint, mean over trajectories.
    """

    nmse: dict[str, float | None]
    mean_nmse: float | None
    rmse: tuple[float | None, ...]
    joint_nmse: tuple[float | None, ...] = ()


def torque_errors(dynamics: Any, samples: Sequence[DynamicsSamples]) -> TorqueErrors:
    """Return the errors of an inverse dynamics on these samples."""
    nmse, rmse = [], []
    for sample in samples:
        q, qd, qdd, tau = map(torch.from_numpy, (sample.q, sample.qd, sample.qdd, sample.tau))
        z = None if sample.z is None else torch.from_numpy(sample.z)
        with torch.no_grad():
            predicted = dynamics.inverse_dynamics(q, qd, qdd, *known_past(dynamics, z))
        squares = (predicted - tau).square().mean(dim=0).numpy()
        variance = sample.tau.var(axis=0)
        nmse.append(np.divide(squares, variance, out=np.full_like(squares, np.nan), where=variance > 0))
        rmse.append(np.sqrt(squares))
    return TorqueErrors(tuple(sample.name for sample in samples), np.array(nmse), np.array(rmse))
