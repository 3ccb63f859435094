"""Torque errors of inverse dynamics on measured trajectories, by one protocol for the model and all baselines."""

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
from spelgen.log_checks.statistics import has_few_levels, quantisation_step
from spelgen.logs.dynamics_samples import DynamicsSamples, is_moving
from spelgen.logs.trajectory import Trajectory, joined_column


@dataclass(frozen=True)
class TorqueErrors:
    """Errors of the inverse dynamics of one predictor on `dynamics_samples`.

    The nMSE is the mean squared error divided by the variance of the torque. All errors except `nmse` are computed from
    the samples of all trajectories together, so that a short log has little weight.

    Attributes:
        nmse: {trajectory: mean nMSE over joints}.
        joint_nmse: nMSE of each joint; None for a joint of constant torque.
        rmse: RMS error of each joint [Nm, N].
        mean_nmse: Mean nMSE over joints.
        nmse_with_pauses: Mean nMSE over joints, with the samples of pauses between motions.
    """

    nmse: dict[str, float | None]
    mean_nmse: float | None
    rmse: tuple[float | None, ...]
    joint_nmse: tuple[float | None, ...] = ()
    nmse_with_pauses: float | None = None

    @property
    def worst_nmse(self) -> float | None:
        """Largest nMSE of all joints (mean squared error / torque variance); None if all torques are constant."""
        return max((nmse for nmse in self.joint_nmse if nmse is not None), default=None)


def torque_errors(dynamics: Any, samples: Sequence[DynamicsSamples]) -> TorqueErrors:
    """Return the torque errors of the inverse dynamics of a predictor on `samples`.

    dynamics: the model or a baseline. samples: motion and torques of each trajectory. Samples of pauses between motions
    are used only for `nmse_with_pauses`.
    """
    errors_by_log, by_trajectory = [], {}
    for sample in samples:
        residual, rows = predicted_torques(dynamics, sample) - sample.tau, is_moving(sample.qd)
        by_trajectory[sample.name] = mean_nmse(residual[rows], sample.tau[rows])
        errors_by_log.append((residual, sample.tau, rows))
    residual, torque, rows = map(np.concatenate, zip(*errors_by_log, strict=True))
    # Errors are pooled over samples: in a mean over logs, one second would have the weight of an hour-long log.
    by_joint = _nmse(residual[rows], torque[rows])
    return TorqueErrors(
        nmse=by_trajectory,
        mean_nmse=_mean(by_joint),
        rmse=finite(np.sqrt(np.square(residual[rows]).mean(axis=0))),
        joint_nmse=finite(by_joint),
        nmse_with_pauses=mean_nmse(residual, torque),
    )


def predicted_torques(dynamics: Any, samples: DynamicsSamples) -> np.ndarray:
    """Return the torques of the inverse dynamics for the motion in `samples`, (T, n) [Nm, N]."""
    motion = map(torch.from_numpy, (samples.q, samples.qd, samples.qdd))
    with torch.no_grad():
        torques: np.ndarray = dynamics.inverse_dynamics(*motion, *friction_past(dynamics, samples)).numpy()
    return torques


def friction_past(dynamics: Any, samples: DynamicsSamples) -> tuple[Tensor, ...]:
    """Return the friction arguments of methods such as `inverse_dynamics`, which follow the arguments q, qd and qdd.

    The first argument is the friction state z: bristle deflections (T, n, K) [rad, m]. The second argument is the
    direction (T, n): the smooth sign of the velocity, after the low-pass filter that the measured torques have passed.
    Arguments that the methods of `dynamics` do not have are omitted (see `known_past`).
    """
    past = (None if x is None else torch.from_numpy(x) for x in (samples.z, samples.direction))
    return known_past(dynamics, *past)


def mean_nmse(residual: np.ndarray, torque: np.ndarray) -> float | None:
    """Return the mean over joints of the nMSE, the mean squared torque error divided by the variance of the torque.

    None is returned if all torques are constant, or if an error is not finite. residual, torque: (T, n) [Nm, N].
    """
    return _mean(_nmse(residual, torque))


def _nmse(residual: np.ndarray, torque: np.ndarray) -> np.ndarray:
    """Return the nMSE of each joint, (n,): the mean squared residual divided by the variance of the torque.

    It is NaN for a joint of constant torque. residual, torque: (T, n) [Nm, N].
    """
    deviation = torque.std(axis=0)
    largest = np.abs(torque).max(axis=0, initial=0.0)
    # A torque is treated as constant if its standard deviation is at the level of rounding errors.
    varies = deviation > LEAST_SQUARES.negligible * largest
    # A residual that is not finite gives an infinite nMSE, because NaN is reserved for joints of constant torque.
    squares = np.nan_to_num(np.square(residual).mean(axis=0), nan=np.inf, posinf=np.inf)
    nmse: np.ndarray = np.full_like(squares, np.nan)
    nmse[varies] = squares[varies] / deviation[varies] ** 2
    return nmse


def _mean(nmse: np.ndarray) -> float | None:
    """Return the mean of nMSE values (n,) over the joints of varying torque, i.e. without NaN.

    None is returned if all torques are constant, or if an nMSE is infinite.
    """
    varying = nmse[~np.isnan(nmse)]
    return finite(varying.mean(keepdims=True))[0] if varying.size else None


def coarse_torques(
    logs: Sequence[Trajectory], joints: Sequence[str], notes: list[Diagnostic]
) -> dict[str, float]:
    """Return {joint: quantisation step of its torque [Nm, N]} for joints whose torque varies by only a few steps.

    A note about each of these joints is appended to `notes`.
    """
    steps = {}
    for k, joint in enumerate(joints):
        # The quantisation step of a joint's torque is the median over the logs. A log without a quantisation step has
        # the value infinity, so the median is finite only if most logs are quantised.
        step = float(np.median(np.nan_to_num([quantisation_step(log.tau[:, k]) for log in logs], nan=np.inf)))
        torque = joined_column(logs, "tau")[:, k]
        if np.isfinite(step) and has_few_levels(step, float(np.ptp(torque))):
            steps[joint] = step
            message = (
                f"the torque of {joint} is logged in steps of {step:.3g}, as large as the torque itself: "
                "these steps determine its error, and the assessment omits this joint"
            )
            notes.append(Diagnostic("warning", "coarse-torque", "logs", None, message))
    return steps
