"""Curves of an evaluation (errors, motions, torques, M, friction) for charts of pages, and `traces` in evaluation.json.

All curves are arrays in SI units [rad, m, s, Nm, N, kg m^2, J], with NaN for unknown numbers. In JSON, numbers have
five significant digits.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from spelgen.dynamics.protocol import RigidDynamics
from spelgen.evaluation.horizons import EvaluatedLogs, Predictions
from spelgen.evaluation.plain import Curve, number
from spelgen.evaluation.replay import PositionErrors
from spelgen.evaluation.torque import friction_past, mean_nmse, predicted_torques
from spelgen.evaluation.tuning import TUNING
from spelgen.fitting.rollout import AT_REST, loss_scales, position_difference
from spelgen.labels import MODEL, is_drawn
from spelgen.logs.dynamics_samples import DynamicsSamples
from spelgen.logs.trajectory import Trajectory, coverage, joined_column
from spelgen.logs.windows import Windows
from spelgen.runtime.parts import applied
from spelgen.runtime.port_hamiltonian import PortHamiltonian


@dataclass(frozen=True, eq=False, kw_only=True)
class DrawnMotion:
    """Base class of the motions that charts show: positions q (T, n) [rad, m] along a segment of a log.

    t: times (T,) [s] since the first sample of the segment. which: "typical" for the motion of median error, "worst"
    for the motion of largest error. error: error of the model on this motion, None if not finite; its definition and
    unit are given in the derived classes.
    """

    which: str = ""
    trajectory: str
    error: float | None = None
    t: Curve
    q: Curve


@dataclass(frozen=True, eq=False, kw_only=True)
class PredictedMotion(DrawnMotion):
    """A measured motion and its prediction, (T, n) each: a predicted window of a log, or a replayed log.

    Attributes:
        start: Time t of the first sample of the window in the log [s]; None for a replayed log.
        predicted_q: Predicted positions, (T, n) [rad, m].
        qd: Measured velocities, (T, n) [rad/s, m/s]; None for a replayed log.
        predicted_qd: Predicted velocities, (T, n) [rad/s, m/s]; None for a replayed log.
        u: Commands of position servos, (T, n) [rad, m]; None for a window.
        error: For a window: RMS over joints of the relative errors of q and qd at the last sample [1]. A relative error
            is an error divided by the RMS change of its quantity since the first sample, over all windows. For a
            replayed log: RMS position error [rad, m].
    """

    start: float | None = None
    predicted_q: Curve
    qd: Curve | None = None
    predicted_qd: Curve | None = None
    u: Curve | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class TorqueTrace(DrawnMotion):
    """Measured joint torques along ten seconds of a log, and the torques of the predictors (model and baselines).

    Attributes:
        error: Normalised mean squared error (nMSE) of the torques of the model.
        measured: Measured joint torques, (T, n) [Nm, N].
        predicted: {name of a predictor: predicted joint torques, (T, n) [Nm, N]}.
        parts: {name of a term: torque, (T, n) [Nm, N]}, for the inertia, Coriolis, gravity and friction term of the
            model.
    """

    qd: Curve
    measured: Curve
    predicted: dict[str, Curve]
    parts: dict[str, Curve]


_Drawn = TypeVar("_Drawn", bound=DrawnMotion)


@dataclass(frozen=True, eq=False)
class Quantiles:
    """Quantiles (10, 50 and 90 %) of an error over all windows, at each time of a prediction."""

    low: Curve
    median: Curve
    high: Curve


@dataclass(frozen=True, eq=False)
class Growth:
    """Growth of the prediction error (an RMS over q and qd of all joints) with the time since the start.

    Attributes:
        seconds: Times since the start of a prediction, (T,) [s].
        windows: Number of predictions.
        relative: {predictor: 10, 50 and 90 % quantiles of the relative error over the windows}. The errors of q and qd
            of each joint are divided by the RMS change of this q or qd since the start, over all windows.
    """

    seconds: Curve
    windows: int
    relative: dict[str, Quantiles]


@dataclass(frozen=True, eq=False)
class MassTrace:
    """M along a trajectory at times t (T,) [s].

    by: {predictor: lower triangle of M, (entries, T) [kg m^2, kg m, kg], with the entries in row-major order}.
    """

    trajectory: str
    t: Curve
    by: dict[str, Curve]


@dataclass(frozen=True, eq=False)
class FrictionTrace:
    """Friction torque of each joint as a function of the joint's velocity.

    Only one joint moves at a time, and the arm is at the mean position of the logs.

    Attributes:
        qd: Velocities of each joint, (n, T) [rad/s, m/s].
        by: {predictor: friction torques of each joint, (n, T) [Nm, N]}.
    """

    qd: Curve
    by: dict[str, Curve]


@dataclass(frozen=True, eq=False)
class Traces:
    """All curves of an evaluation.

    Attributes:
        coverage: Ranges of motion in the test logs, see `logs.trajectory.coverage`.
        growth: Growth of the prediction error over time.
        trajectories: Predicted windows or replayed logs, of median and of largest error.
        torques: Torques along logs, of median and of largest error.
        mass: M of all predictors along a motion.
        friction: Friction of all predictors over velocity.
    """

    coverage: dict[str, object]
    growth: Growth | None = None
    trajectories: tuple[PredictedMotion, ...] = ()
    torques: tuple[TorqueTrace, ...] = ()
    mass: MassTrace | None = None
    friction: FrictionTrace | None = None


def motion_traces(
    dynamics: Mapping[str, RigidDynamics],
    logs: EvaluatedLogs,
    predictions: Predictions | None,
) -> Traces:
    """Return all curves of the evaluation of an arm under torques.

    Args:
        dynamics: {name of a predictor (the model or a baseline): dynamics}.
        logs: test logs.
        predictions: predictions over the longest horizon; None if no horizon was evaluated.
    """
    growth = None
    predicted: tuple[PredictedMotion, ...] = ()
    # If the arm is at rest in the windows, relative errors would be divided by a change of zero, so the curves of
    # predicted motion are omitted.
    if predictions is not None and predictions.windows.q.diff(dim=1).abs().max() >= AT_REST:
        errors = _relative_errors(predictions, logs.joint_types)
        growth = _growth(predictions.windows, errors)
        predicted = _predicted_motions(predictions, errors[MODEL][:, -1])
    torques = _typical_and_worst([_torque_trace(dynamics, motion) for motion in _torque_motions(logs)])
    drawn = (*torques, *predicted)
    return Traces(
        coverage=coverage(logs.pieces),
        growth=growth,
        trajectories=predicted,
        torques=torques,
        mass=_mass_trace(dynamics, drawn[0]) if drawn else None,
        friction=_friction_trace(dynamics, logs.pieces),
    )


def replay_traces(errors: Sequence[PositionErrors]) -> Traces:
    """Return the curves for the charts of an arm under position servos: measured and predicted positions of two logs.

    One log has the median position error of all replayed logs, the other log the largest. The result also contains the
    range of motion of the logs. errors: replayed logs with the position errors of the model, (T, n) [rad, m].
    """
    motions = [_thinned(_replayed_motion(log, error), TUNING.log_samples) for log, error in errors]
    return Traces(coverage([log for log, _ in errors]), trajectories=_typical_and_worst(motions))


def _relative_errors(predictions: Predictions, joint_types: Sequence[str]) -> dict[str, Tensor]:
    """Return {predictor: relative error, (W, K-1)} for W windows of K samples, without the initial sample.

    The relative error is the RMS over the errors of position and velocity of all joints. Each of these errors is
    divided by the RMS change of the position or velocity since the start of a window (see `loss_scales`).
    """
    windows = predictions.windows
    scales = loss_scales(windows, joint_types)
    errors = {}
    for name, (q, qd) in predictions.states.items():
        position = position_difference(q, windows.q[:, 1:], joint_types) / scales.q
        velocity = (qd - windows.qd[:, 1:]) / scales.qd
        errors[name] = torch.cat([position, velocity], dim=-1).square().mean(dim=-1).sqrt()
    return errors


def _growth(windows: Windows, errors: Mapping[str, Tensor]) -> Growth:
    seconds = windows.dt.cumsum(dim=1).mean(dim=0).numpy()
    # The times of the curve are spaced geometrically, because errors grow by orders of magnitude.
    times = np.unique(np.geomspace(1, len(seconds), TUNING.curve_times).round().astype(int)) - 1
    relative = {name: _quantiles(error[:, times]) for name, error in errors.items() if is_drawn(name)}
    return Growth(seconds[times], len(windows), relative)


def _predicted_motions(predictions: Predictions, errors: Tensor) -> tuple[PredictedMotion, ...]:
    """Return two predicted windows of the model: the window of median error and the window of largest error.

    The first sample of a predicted motion is the measured initial state. errors: relative error of the model at the end
    of each of W windows, (W,).
    """
    windows = predictions.windows
    q, qd = predictions.states[MODEL]
    motions = []
    for k, ((piece, first), error) in enumerate(zip(predictions.starts, errors.tolist(), strict=True)):
        motion = PredictedMotion(
            trajectory=piece.name,
            start=number(piece.t[first]),
            error=number(error),
            t=torch.cat([windows.dt.new_zeros(1), windows.dt[k].cumsum(dim=0)]).numpy(),
            q=windows.q[k].numpy(),
            qd=windows.qd[k].numpy(),
            predicted_q=torch.cat([windows.q[k, :1], q[k]]).numpy(),
            predicted_qd=torch.cat([windows.qd[k, :1], qd[k]]).numpy(),
        )
        motions.append(_thinned(motion, TUNING.curve_samples))
    return _typical_and_worst(motions)


def _quantiles(values: Tensor) -> Quantiles:
    """Return the 10, 50 and 90 % quantiles of the errors of W windows, (T,) each; NaN counts as infinite.

    values: errors (W, T) at T times.
    """
    errors = values.nan_to_num(nan=torch.inf).numpy()
    return Quantiles(*np.quantile(errors, (0.1, 0.5, 0.9), axis=0, method="nearest"))


def _mass_trace(dynamics: Mapping[str, RigidDynamics], motion: DrawnMotion) -> MassTrace:
    """Return the entries of M over time along a measured motion, for each predictor (the model and its baselines)."""
    q = torch.from_numpy(motion.q.copy())
    row, column = np.tril_indices(q.shape[-1])
    curves = {}
    for name, predictor in dynamics.items():
        with torch.no_grad():
            mass = torch.as_tensor(predictor.mass_matrix(q)).numpy()
        # Curves with infinite values are omitted: they would make the axis useless for all other curves.
        if np.isfinite(mass).all():
            curves[name] = mass[:, row, column].T
    return MassTrace(motion.trajectory, motion.t, curves)


def _friction_trace(dynamics: Mapping[str, RigidDynamics], pieces: Sequence[Trajectory]) -> FrictionTrace:
    q = joined_column(pieces, "q")
    # The largest speed of a joint's friction curve is a quantile of the logged speeds and not their maximum, because
    # velocities that were differentiated from positions often have spikes.
    fast = np.quantile(np.abs(joined_column(pieces, "qd")), 0.995, axis=0)
    # The grid of speeds is finer near zero, where the sign of friction changes.
    grid = np.sinh(np.linspace(-4, 4, 81)) / np.sinh(4)
    speeds = torch.from_numpy(grid[:, None] * fast)  # speeds: (81, n), 81 speeds of each joint
    # velocity vectors (81, n, n): entry [k, j] is the vector at which joint j has its speed k and the other joints rest
    alone = torch.diag_embed(speeds)
    positions = torch.from_numpy(q.mean(axis=0)).expand_as(alone)
    curves = {}
    for name, predictor in dynamics.items():
        with torch.no_grad():
            torque = torch.as_tensor(predictor.friction_torque(positions, alone))
        curves[name] = torch.diagonal(torque, dim1=-2, dim2=-1).mT.numpy()
    return FrictionTrace(speeds.mT.numpy(), curves)


def _typical_and_worst(motions: Sequence[_Drawn]) -> tuple[_Drawn, ...]:
    """Return the motion of median error and the motion of largest error; a single motion is returned once.

    The field `which` of the returned motions is set to "typical" and "worst".
    """
    # Sorting keeps the order of motions with equal errors, so the same logs always give the same page.
    ordered = sorted(motions, key=lambda motion: math.inf if motion.error is None else motion.error)
    if not ordered:
        return ()
    chosen = [replace(ordered[(len(ordered) - 1) // 2], which="typical")]
    if len(ordered) > 1:
        chosen.append(replace(ordered[-1], which="worst"))
    return tuple(chosen)


def _thinned(motion: PredictedMotion, max_samples: int) -> PredictedMotion:
    """Return every k-th sample of a motion, for a chart; k is the smallest stride that gives at most `max_samples`."""
    # Samples are omitted, not averaged: a filter would hide spikes, which the reported errors contain.
    stride = -(-len(motion.t) // max_samples)
    arrays = {name: values for name, values in vars(motion).items() if isinstance(values, np.ndarray)}
    curves: dict[str, Any] = {name: values[::stride] for name, values in arrays.items()}
    return replace(motion, **curves)


def _replayed_motion(log: Trajectory, error: np.ndarray) -> PredictedMotion:
    """Return the measured and the predicted motion along a replayed log of position servos, for a chart.

    error: (T-1, n) predicted minus measured positions [rad, m] at all samples except the first.
    """
    return PredictedMotion(
        trajectory=log.name,
        error=number(float(np.sqrt(np.square(error).mean()))),
        t=log.t - log.t[0],
        q=log.q,
        u=log.u,
        # The first position is the initial condition, so it is measured and not predicted.
        predicted_q=np.concatenate([log.q[:1], log.q[1:] + error]),
    )


def _torque_motions(logs: EvaluatedLogs) -> list[DynamicsSamples]:
    """Return the middle ten seconds of each log, subsampled for charts.

    The middle is used because logs begin and end at rest.
    """
    motions = []
    for samples in logs.samples:
        count = min(len(samples.q), round(TUNING.torque_seconds * samples.rate) + 1)
        start = (len(samples.q) - count) // 2
        motions.append(samples[start : start + count : -(-count // TUNING.curve_samples)])
    return motions


def _torque_trace(dynamics: Mapping[str, RigidDynamics], samples: DynamicsSamples) -> TorqueTrace:
    """Return the torques along `samples` for a chart: measured, predicted by each predictor, and terms of the model.

    dynamics: {name of a predictor: dynamics}, with the trained model under the name `MODEL`. Its torque is also
    returned as a sum of four terms: inertia, Coriolis, gravity and friction torque.
    """
    model = dynamics[MODEL]
    q, qd, qdd = map(torch.from_numpy, (samples.q, samples.qd, samples.qdd))
    with torch.no_grad():
        inputs = np.eye(q.shape[-1])
        # The input matrix G of a model may couple motors and joints; other dynamics have G = 1.
        if isinstance(model, PortHamiltonian):
            inputs = model.input_matrix(q).numpy()
        gravity = model.gravity(q)
        curves = {
            "inertia": applied(model.mass_matrix(q), qdd).numpy(),
            "Coriolis": (model.nonlinear_effects(q, qd) - gravity).numpy(),
            "gravity": gravity.numpy(),
            "friction": model.friction_torque(q, qd, *friction_past(model, samples)).numpy(),
        }
    torques = {name: predicted_torques(predictor, samples) for name, predictor in dynamics.items()}
    predicted = {name: _at_joints(inputs, torque) for name, torque in torques.items()}
    # Logs contain motor torques. They are converted to joint torques, because the terms of the model are joint torques.
    measured = _at_joints(inputs, samples.tau)
    return TorqueTrace(
        trajectory=samples.name,
        error=mean_nmse(predicted[MODEL] - measured, measured),
        # The samples are evenly spaced, so the times are computed from the sample rate.
        t=np.arange(len(samples.q)) / samples.rate,
        q=samples.q,
        qd=samples.qd,
        measured=measured,
        predicted=predicted,
        parts=curves,
    )


def _at_joints(inputs: np.ndarray, torques: np.ndarray) -> np.ndarray:
    """Return joint torques (T, n) [Nm, N] for motor torques (T, n); inputs: input matrix G, (n, n) or (T, n, n)."""
    return np.asarray((inputs @ torques[..., None])[..., 0])
