"""Selection of the motions that charts show.

Charts show two predicted windows, two torque curves and two replayed logs: in each case the motion with the median
error and the motion with the largest error of the trained model. Predictors are the trained model and the baselines.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
import torch

from spelgen.baselines.predictor import States
from spelgen.dynamics.protocol import RigidDynamics
from spelgen.evaluation.horizons import EvaluatedLogs
from spelgen.evaluation.plain import Curve, number
from spelgen.evaluation.torque import friction_past, mean_nmse, predicted_torques
from spelgen.evaluation.tuning import TUNING
from spelgen.labels import MODEL
from spelgen.logs.dynamics_samples import DynamicsSamples
from spelgen.logs.trajectory import Trajectory
from spelgen.logs.windows import Windows
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


Drawn = TypeVar("Drawn", bound=DrawnMotion)


def typical_and_worst(motions: Sequence[Drawn]) -> tuple[Drawn, ...]:
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


def thinned(motion: PredictedMotion, max_samples: int) -> PredictedMotion:
    """Return every k-th sample of a motion, for a chart; k is the smallest stride that gives at most `max_samples`."""
    # Samples are omitted, not averaged: a filter would hide spikes, which the reported errors contain.
    stride = -(-len(motion.t) // max_samples)
    arrays = {name: values for name, values in vars(motion).items() if isinstance(values, np.ndarray)}
    curves: dict[str, Any] = {name: values[::stride] for name, values in arrays.items()}
    return replace(motion, **curves)


def predicted_motion(trajectory: str, windows: Windows, states: States, k: int) -> PredictedMotion:
    """Return the measured and the predicted motion of window k, for a chart.

    trajectory: name of the log. windows: measured motion of W windows. states: predicted q and qd of the windows after
    their first sample, (W, T-1, n) each. The first sample of the predicted motion is the measured initial state.
    """
    predicted_q, predicted_qd = states
    return PredictedMotion(
        trajectory=trajectory,
        t=torch.cat([windows.dt.new_zeros(1), windows.dt[k].cumsum(dim=0)]).numpy(),
        q=windows.q[k].numpy(),
        qd=windows.qd[k].numpy(),
        predicted_q=torch.cat([windows.q[k, :1], predicted_q[k]]).numpy(),
        predicted_qd=torch.cat([windows.qd[k, :1], predicted_qd[k]]).numpy(),
    )


def replayed_motion(log: Trajectory, error: np.ndarray) -> PredictedMotion:
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


def torque_motions(logs: EvaluatedLogs) -> list[DynamicsSamples]:
    """Return the middle ten seconds of each log, subsampled for charts.

    The middle is used because logs begin and end at rest.
    """
    motions = []
    for samples in logs.samples:
        count = min(len(samples.q), round(TUNING.torque_seconds * samples.rate) + 1)
        start = (len(samples.q) - count) // 2
        motions.append(samples[start : start + count : -(-count // TUNING.curve_samples)])
    return motions


def torque_trace(dynamics: Mapping[str, RigidDynamics], samples: DynamicsSamples) -> TorqueTrace:
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
            "inertia": (model.mass_matrix(q) @ qdd.unsqueeze(-1)).squeeze(-1).numpy(),
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
