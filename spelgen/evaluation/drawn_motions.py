"""The motions that charts show: predictions, torques and replays of median and of largest error."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
import torch
from scipy.integrate import cumulative_trapezoid

from spelgen.baselines.predictor import States
from spelgen.dynamics.bristles import bristles_along
from spelgen.dynamics.protocol import RigidDynamics
from spelgen.evaluation.horizons import EvaluatedLogs
from spelgen.evaluation.plain import Curve, number
from spelgen.evaluation.torque import friction_past, mean_nmse, predicted_torques
from spelgen.evaluation.tuning import TUNING
from spelgen.labels import MODEL
from spelgen.logs.dynamics_samples import DynamicsSamples
from spelgen.logs.trajectory import Trajectory
from spelgen.logs.tuning import shows_accelerations
from spelgen.logs.windows import Windows, cut_windows
from spelgen.runtime.port_hamiltonian import PortHamiltonian


@dataclass(frozen=True, eq=False, kw_only=True)
class DrawnMotion:
    """Positions q (T, n) along a part of a log, at times t (T,) [s] from its first sample.

    which: "typical" for the median error of all such motions, "worst" for the largest. error: None if not finite.
    """

    which: str = ""
    trajectory: str
    error: float | None = None
    t: Curve
    q: Curve


@dataclass(frozen=True, eq=False, kw_only=True)
class PredictedMotion(DrawnMotion):
    """A motion and its prediction, (T, n). error: divided by the motion, or RMS [rad, m] of a replayed log.

    start: time of the first sample in the log [s]; None of a log that is replayed as a whole. u: commands of position
    servos, without velocities.
    """

    start: float | None = None
    predicted_q: Curve
    qd: Curve | None = None
    predicted_qd: Curve | None = None
    u: Curve | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class TorqueTrace(DrawnMotion):
    """Joint torques (T, n) [Nm, N] along ten seconds of a log; error: nMSE of the model.

    predicted: by predictor. parts: terms of the model's torque. energy: work of the drives since the start and its
    parts, (T,) [J].
    """

    qd: Curve
    measured: Curve
    predicted: dict[str, Curve]
    parts: dict[str, Curve]
    energy: dict[str, Curve]


Drawn = TypeVar("Drawn", bound=DrawnMotion)


def typical_and_worst(motions: Sequence[Drawn]) -> tuple[Drawn, ...]:
    """Return the motion of median error, and the motion of largest error if there are several."""
    # a sort keeps the order of equal errors: the same logs give the same page
    ordered = sorted(motions, key=lambda motion: math.inf if motion.error is None else motion.error)
    if not ordered:
        return ()
    chosen = [replace(ordered[(len(ordered) - 1) // 2], which="typical")]
    if len(ordered) > 1:
        chosen.append(replace(ordered[-1], which="worst"))
    return tuple(chosen)


def thinned(motion: PredictedMotion, max_samples: int) -> PredictedMotion:
    """Return the motion at about `max_samples` samples at most."""
    # every sample at the same distance: filtered curves would hide spikes that the errors contain
    stride = -(-len(motion.t) // max_samples)
    arrays = {name: values for name, values in vars(motion).items() if isinstance(values, np.ndarray)}
    curves: dict[str, Any] = {name: values[::stride] for name, values in arrays.items()}
    return replace(motion, **curves)


def predicted_motion(trajectory: str, windows: Windows, states: States, k: int = 0) -> PredictedMotion:
    """Return window k and its prediction."""
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
    """Return the measured and the predicted motion of a log of position servos.

    error: (T-1, n) predicted minus measured positions after the first sample [rad, m]."""
    return PredictedMotion(
        trajectory=log.name,
        error=number(float(np.sqrt(np.square(error).mean()))),
        t=log.t - log.t[0],
        q=log.q,
        u=log.u,
        # the first position is given, not predicted
        predicted_q=np.concatenate([log.q[:1], log.q[1:] + error]),
    )


def torque_motions(logs: EvaluatedLogs) -> list[DynamicsSamples]:
    """Return ten seconds from the middle of each log, as logs begin and end at rest, at the samples of a chart."""
    motions = []
    # logs too slow for accelerations by a filter still show their torques
    slow = [piece for piece in logs.pieces if not shows_accelerations(piece.sample_rate)]
    for samples in [*logs.samples, *(_steps(piece, logs) for piece in slow)]:
        count = min(len(samples.q), round(TUNING.torque_seconds * samples.rate) + 1)
        start = (len(samples.q) - count) // 2
        motions.append(samples[start : start + count : -(-count // TUNING.curve_samples)])
    return motions


def _steps(piece: Trajectory, logs: EvaluatedLogs) -> DynamicsSamples:
    """Return the sample intervals of a log too slow for a filter: mean motion, acceleration and torque in each."""
    steps = cut_windows([piece], 2, measured=logs.used.filtered)
    qdd = steps.qd.diff(dim=1)[:, 0] / steps.dt
    q, qd, tau = steps.q.mean(dim=1).numpy(), steps.qd.mean(dim=1).numpy(), steps.tau[:, 0].numpy()
    z = bristles_along(q, logs.reach)
    return DynamicsSamples(piece.name, q, qd, qdd.numpy(), tau, z, rate=piece.sample_rate)


def torque_trace(dynamics: Mapping[str, RigidDynamics], samples: DynamicsSamples) -> TorqueTrace:
    """Return the torques of all predictors on these samples, and the terms of the model's torque."""
    model: Any = dynamics[MODEL]
    q, qd, qdd = map(torch.from_numpy, (samples.q, samples.qd, samples.qdd))
    with torch.no_grad():
        inputs = np.eye(q.shape[-1])
        if isinstance(model, PortHamiltonian):  # gears may connect motors and joints
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
    # at the joints, where the terms of the model act; logs have the torques of the motors
    measured = _at_joints(inputs, samples.tau)
    # the samples are evenly spaced after the filter
    t = np.arange(len(samples.q)) / samples.rate
    # friction includes an offset of the torque
    stored = curves["inertia"] + curves["Coriolis"] + curves["gravity"]
    works = {
        "work of the drives": measured,
        "stored": stored,
        "friction": predicted[MODEL] - stored,
        "not explained": measured - predicted[MODEL],
    }
    power = {name: (torque * samples.qd).sum(axis=-1) for name, torque in works.items()}
    energy = {name: cumulative_trapezoid(values, t, initial=0) for name, values in power.items()}
    return TorqueTrace(
        trajectory=samples.name,
        error=mean_nmse(predicted[MODEL] - measured, measured),
        t=t,
        q=samples.q,
        qd=samples.qd,
        measured=measured,
        predicted=predicted,
        parts=curves,
        energy=energy,
    )


def _at_joints(inputs: np.ndarray, torques: np.ndarray) -> np.ndarray:
    """Return joint torques (T, n) of motor torques; inputs: (n, n) or (T, n, n)."""
    by_joint: np.ndarray = (inputs @ torques[..., None])[..., 0]
    return by_joint
