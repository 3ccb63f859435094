"""Torques along test trajectories: measured, predicted, what they are made of, and where the energy goes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from scipy.integrate import cumulative_trapezoid

from spelgen.baselines.names import MODEL
from spelgen.dynamics.bristles import bristles_along, direction_along
from spelgen.evaluation.horizons import JudgedLogs
from spelgen.evaluation.plain import Curve
from spelgen.evaluation.torque import friction_past, mean_nmse, predicted_torques
from spelgen.logs.dynamics_samples import FREQUENCY, DynamicsSamples, dynamics_samples
from spelgen.logs.rates import shows_accelerations
from spelgen.logs.trajectory import Trajectory
from spelgen.settings.tuning.evaluation import TraceTuning

if TYPE_CHECKING:
    from spelgen.dynamics.protocol import RigidDynamics

TUNING = TraceTuning()


@dataclass(frozen=True, eq=False)
class TorqueTrace:
    """Torques (T, n) along ten seconds of the log of middle ("typical") or largest ("worst") error.

    predicted: by predictor. parts: of the model's torque. energy: by where the drives' work went since the start, (T,)
    [J].
    """

    which: str
    trajectory: str
    t: Curve
    q: Curve
    qd: Curve
    measured: Curve
    predicted: dict[str, Curve]
    parts: dict[str, Curve]
    energy: dict[str, Curve]


Motion = tuple[np.ndarray, DynamicsSamples]
"""Times (T,) [s], and the samples at them."""


def torque_traces(dynamics: Mapping[str, RigidDynamics], logs: JudgedLogs) -> tuple[TorqueTrace, ...]:
    """Return the traces of the log of middle error and of that of largest error by the model, if there are two."""
    motions: list[Motion] = []
    errors = []
    for piece in logs.pieces:
        motion = _sparse_motion(piece, logs)
        if shows_accelerations(piece.sample_rate):
            motion = _dense_motion(piece, logs)
        if len(motion[0]) < 2:
            continue
        t, samples = _middle(*motion)
        error = mean_nmse(predicted_torques(dynamics[MODEL], samples) - samples.tau, samples.tau)
        motions.append((t, samples))
        errors.append(math.inf if error is None else error)
    chosen = typical_and_worst(errors)
    return tuple(_trace(which, dynamics, *motions[k]) for which, k in chosen.items())


def typical_and_worst(errors: Sequence[float]) -> dict[str, int]:
    """Return which of these errors is in the middle, and which is the largest of several."""
    # stable: the same logs give the same page
    order = np.argsort(np.nan_to_num(errors, nan=math.inf), kind="stable").tolist()
    chosen = {}
    if order:
        chosen["typical"] = order[(len(order) - 1) // 2]
    if len(order) > 1:
        chosen["worst"] = order[-1]
    return chosen


def _middle(t: np.ndarray, samples: DynamicsSamples) -> Motion:
    """Return up to ten seconds from the middle: logs begin and end at rest."""
    count = min(len(t), int(np.searchsorted(t - t[0], TUNING.torque_seconds)) + 1)
    start = (len(t) - count) // 2
    span = slice(start, start + count)
    columns: dict[str, Any] = {
        name: x[span] for name, x in vars(samples).items() if isinstance(x, np.ndarray)
    }
    return t[span] - t[start], replace(samples, **columns)


def _dense_motion(piece: Trajectory, logs: JudgedLogs) -> Motion:
    """Return the samples that move, none where nothing does."""
    used = logs.used
    # pieces are filtered and their torques moved already
    used = replace(used, torque_delay=0.0, cutoff=0.0 if used.filtered else used.cutoff)
    moving = dynamics_samples([piece], pauses=True, preprocessing=used, reach=logs.reach)
    if not moving:
        return np.zeros(0), DynamicsSamples(piece.name, *[np.zeros(0)] * 4)
    return np.arange(len(moving[0].q)) / FREQUENCY, moving[0]


def _sparse_motion(piece: Trajectory, logs: JudgedLogs) -> Motion:
    """Return the differences from sample to sample, at the middle of each step, and the torque that acted then."""
    z = None
    if logs.reach.elements:
        z = _midpoints(bristles_along(piece.q, logs.reach))
    tau = piece.tau[:-1]  # held from its sample on, as simulators apply it
    if logs.used.filtered:
        # measured at its sample: a filter has no delay
        tau = _midpoints(piece.tau)
    qd = _midpoints(piece.qd)
    qdd = np.diff(piece.qd, axis=0) / np.diff(piece.t)[:, None]
    direction = direction_along(qd, logs.reach)
    return _midpoints(piece.t), DynamicsSamples(piece.name, _midpoints(piece.q), qd, qdd, tau, z, direction)


def _midpoints(x: np.ndarray) -> np.ndarray:
    middle: np.ndarray = (x[1:] + x[:-1]) / 2
    return middle


def _trace(
    which: str, dynamics: Mapping[str, RigidDynamics], t: np.ndarray, samples: DynamicsSamples
) -> TorqueTrace:
    model: Any = dynamics[MODEL]
    q, qd, qdd = map(torch.from_numpy, (samples.q, samples.qd, samples.qdd))
    inputs = np.eye(q.shape[-1])
    with torch.no_grad():
        if hasattr(model, "input_matrix"):  # gears may stand between a motor and a joint
            inputs = model.input_matrix(q).numpy()
        gravity = model.gravity(q)
        parts = {
            "inertia": (model.mass_matrix(q) @ qdd.unsqueeze(-1)).squeeze(-1).numpy(),
            "Coriolis": (model.nonlinear_effects(q, qd) - gravity).numpy(),
            "gravity": gravity.numpy(),
            "friction": model.friction_torque(q, qd, *friction_past(model, samples)).numpy(),
        }
    predicted = {}
    for name, predictor in dynamics.items():
        predicted[name] = _at_joints(inputs, predicted_torques(predictor, samples))
    measured = _at_joints(inputs, samples.tau)
    energy = _energy(t, samples.qd, measured, predicted[MODEL], parts)
    stride = -(-len(t) // TUNING.samples)
    return TorqueTrace(
        which=which,
        trajectory=samples.name,
        t=t[::stride],
        q=samples.q[::stride],
        qd=samples.qd[::stride],
        measured=measured[::stride],
        predicted=_thinned(predicted, stride),
        parts=_thinned(parts, stride),
        energy=_thinned(energy, stride),
    )


def _at_joints(inputs: np.ndarray, torques: np.ndarray) -> np.ndarray:
    """Return the joints' torques of the motors'."""
    by_joint: np.ndarray = (inputs @ torques[..., None])[..., 0]
    return by_joint


def _thinned(curves: Mapping[str, np.ndarray], stride: int) -> dict[str, np.ndarray]:
    return {label: curve[::stride] for label, curve in curves.items()}


def _energy(
    t: np.ndarray,
    qd: np.ndarray,
    measured: np.ndarray,
    predicted: np.ndarray,
    parts: Mapping[str, np.ndarray],
) -> dict[str, np.ndarray]:
    """Return where the drives' work went since the start, (T,) [J]: stored, lost to friction, not explained.

    Powers are of the model's torques on the measured motion; an offset of the torque is with the friction.
    """
    stored = parts["inertia"] + parts["Coriolis"] + parts["gravity"]
    torques = {
        "work of the drives": measured,
        "stored": stored,
        "friction": predicted - stored,
        "not explained": measured - predicted,
    }
    work = {}
    for name, torque in torques.items():
        work[name] = cumulative_trapezoid((torque * qd).sum(axis=-1), t, initial=0)
    return work
