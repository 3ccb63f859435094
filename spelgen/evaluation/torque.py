"""Torque errors of inverse dynamics on measured trajectories, by one protocol: comparable figures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from spelgen.dynamics.protocol import known_past
from spelgen.errors import Diagnostic
from spelgen.evaluation.plain import finite
from spelgen.identification.tuning import TUNING as LEAST_SQUARES
from spelgen.log_checks.statistics import quantisation_step
from spelgen.log_checks.tuning import TUNING as LOG_CHECKS
from spelgen.logs.dynamics_samples import DynamicsSamples, is_moving
from spelgen.logs.trajectory import Trajectory, joined_column

LEVELS = LOG_CHECKS.levels
NEGLIGIBLE = LEAST_SQUARES.negligible


@dataclass(frozen=True)
class TorqueErrors:
    """Errors of the inverse dynamics of one predictor by the protocol of `dynamics_samples`.

    An nMSE is the mean squared error by the variance of the torque. nmse: of each trajectory, mean over joints. All
    others are pooled over the samples of all trajectories, so that a log that is short or hardly moves weighs no more
    than its samples. joint_nmse, rmse [Nm, N]: by joint, None where the torque never varies. mean_nmse: mean over
    joints. nmse_with_pauses: the same with the pauses between motions.
    """

    nmse: dict[str, float | None]
    mean_nmse: float | None
    rmse: tuple[float | None, ...]
    joint_nmse: tuple[float | None, ...] = ()
    nmse_with_pauses: float | None = None

    @property
    def worst_nmse(self) -> float | None:
        """Return the largest of joint_nmse, which a mean hides."""
        return max((nmse for nmse in self.joint_nmse if nmse is not None), default=None)


def torque_errors(dynamics: Any, samples: Sequence[DynamicsSamples]) -> TorqueErrors:
    """Return the errors of an inverse dynamics on these samples, of which those of pauses count apart."""
    residuals, torques, moving, by_trajectory = [], [], [], {}
    for sample in samples:
        residual, rows = predicted_torques(dynamics, sample) - sample.tau, is_moving(sample.qd)
        by_trajectory[sample.name] = mean_nmse(residual[rows], sample.tau[rows])
        residuals.append(residual)
        torques.append(sample.tau)
        moving.append(rows)
    residual, torque, rows = map(np.concatenate, (residuals, torques, moving))
    by_joint = _nmse(residual[rows], torque[rows])
    return TorqueErrors(
        nmse=by_trajectory,
        mean_nmse=_mean(by_joint),
        rmse=finite(np.sqrt(np.square(residual[rows]).mean(axis=0))),
        joint_nmse=finite(by_joint),
        nmse_with_pauses=mean_nmse(residual, torque),
    )


def predicted_torques(dynamics: Any, samples: DynamicsSamples) -> np.ndarray:
    """Return the torques of an inverse dynamics on these samples, (T, n)."""
    q, qd, qdd = map(torch.from_numpy, (samples.q, samples.qd, samples.qdd))
    with torch.no_grad():
        torques: np.ndarray = dynamics.inverse_dynamics(q, qd, qdd, *friction_past(dynamics, samples)).numpy()
    return torques


def friction_past(dynamics: Any, samples: DynamicsSamples) -> tuple[Tensor, ...]:
    """Return what dynamics take of the friction's state on these samples, see `known_past`."""
    z = None if samples.z is None else torch.from_numpy(samples.z)
    direction = None if samples.direction is None else torch.from_numpy(samples.direction)
    return known_past(dynamics, z, direction)


def mean_nmse(residual: np.ndarray, torque: np.ndarray) -> float | None:
    """Return the nMSE as a mean over joints; None where no torque varies or an error is not finite."""
    return _mean(_nmse(residual, torque))


def _nmse(residual: np.ndarray, torque: np.ndarray) -> np.ndarray:
    """Return the nMSE of each joint, (T, n) -> (n,): NaN where the torque never varies."""
    deviation = torque.std(axis=0)
    largest = np.abs(torque).max(axis=0, initial=0.0)
    varies = deviation > NEGLIGIBLE * largest  # else a constant, with rounding
    # a prediction that is not finite must not pass for a torque that says nothing
    squares = np.nan_to_num(np.square(residual).mean(axis=0), nan=np.inf, posinf=np.inf)
    nmse: np.ndarray = np.full_like(squares, np.nan)
    nmse[varies] = squares[varies] / deviation[varies] ** 2
    return nmse


def _mean(nmse: np.ndarray) -> float | None:
    """Return the mean over joints whose torque varies; None where none does or an error is not finite."""
    varying = nmse[~np.isnan(nmse)]
    return finite(varying.mean(keepdims=True))[0] if varying.size else None


def coarse_torques(
    logs: Sequence[Trajectory], joints: Sequence[str], notes: list[Diagnostic]
) -> dict[str, float]:
    """Return by name the steps [Nm, N] of torques that are logged in steps of their own size, and note them."""
    steps = {}
    for k, joint in enumerate(joints):
        # infinite where a log is not quantised: most of them must be
        step = float(np.median(np.nan_to_num([quantisation_step(log.tau[:, k]) for log in logs], nan=np.inf)))
        torque = joined_column(logs, "tau")[:, k]
        if np.isfinite(step) and np.ptp(torque) < LEVELS * step:
            steps[joint] = step
            message = (
                f"the torque of {joint} is logged in steps of {step:.3g}, as large as the torque itself: "
                "its error is that of the log, and the verdict omits this joint"
            )
            notes.append(Diagnostic("warning", "coarse-torque", "logs", None, message))
    return steps
