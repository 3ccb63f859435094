"""Torques along test trajectories: measured, predicted, what they are made of, and where the energy goes."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from spelgen.baselines.names import MODEL
from spelgen.dynamics.bristles import bristles_along, direction_along
from spelgen.dynamics.protocol import known_past
from spelgen.evaluation.horizons import JudgedLogs
from spelgen.evaluation.plain import Rows, Series, rows, series
from spelgen.logs.dynamics_samples import FREQUENCY, dynamics_samples
from spelgen.logs.rates import shows_accelerations
from spelgen.logs.trajectory import Trajectory
from spelgen.settings.tuning.evaluation import TraceTuning

if TYPE_CHECKING:
    from spelgen.dynamics.protocol import RigidDynamics

TUNING = TraceTuning()


@dataclass(frozen=True)
class TorqueTrace:
    """Torques (T, n) along ten seconds of the log of middle ("typical") or largest ("worst") error.

    predicted: by predictor. parts: of the model's torque. energy: by where the drives' work went since the start, (T,)
    [J].
    """

    which: str
    trajectory: str
    t: Series
    q: Rows
    qd: Rows
    measured: Rows
    predicted: dict[str, Rows]
    parts: dict[str, Rows]
    energy: dict[str, Series]


@dataclass(frozen=True, eq=False)
class Motion:
    """What was measured at T times; z: the state of friction, with which it came there.

    direction: (T, n) of dry friction without memory, filtered as tau was.
    """

    t: Tensor
    q: Tensor
    qd: Tensor
    qdd: Tensor
    tau: Tensor
    z: Tensor
    direction: Tensor


def torque_traces(dynamics: Mapping[str, RigidDynamics], logs: JudgedLogs) -> tuple[TorqueTrace, ...]:
    """Return the traces of the log of middle error and of that of largest error by the model, if there are two."""
    model = dynamics[MODEL]
    motions, errors = {}, {}
    for piece in logs.pieces:
        motion = _motion(piece, logs)
        if motion is None:
            continue
        with torch.no_grad():
            missed = _inverse_dynamics(model, motion) - motion.tau
        # a torque that never varies would weigh infinitely
        nmse = missed.square().mean(dim=0) / motion.tau.var(dim=0).clamp(min=1e-12)
        motions[piece.name] = motion
        errors[piece.name] = nmse.mean().nan_to_num(nan=math.inf).item()
    order = sorted(errors, key=lambda name: (errors[name], name))
    if not order:
        return ()
    chosen = {"typical": order[(len(order) - 1) // 2]}
    if len(order) > 1:
        chosen["worst"] = order[-1]
    return tuple(_trace(which, name, dynamics, motions[name]) for which, name in chosen.items())


def _inverse_dynamics(dynamics: Any, motion: Motion) -> Tensor:
    torque = dynamics.inverse_dynamics(
        motion.q, motion.qd, motion.qdd, *known_past(dynamics, motion.z, motion.direction)
    )
    return torch.as_tensor(torque)


def _motion(piece: Trajectory, logs: JudgedLogs) -> Motion | None:
    """Return up to ten seconds from the middle of what moves; None where nothing does."""
    motion: Motion | None = _sparse_motion(piece, logs)
    if shows_accelerations(piece.sample_rate):
        motion = _dense_motion(piece, logs)
    if motion is None:
        return None
    t = motion.t - motion.t[0]
    count = min(len(t), int(torch.searchsorted(t, TUNING.torque_seconds)) + 1)
    start = (len(t) - count) // 2  # logs begin and end at rest
    span = slice(start, start + count)
    return Motion(t[span] - t[start], *(x[span] for x in list(vars(motion).values())[1:]))


def _dense_motion(piece: Trajectory, logs: JudgedLogs) -> Motion | None:
    used = logs.used
    # pieces are filtered and their torques moved already
    used = replace(used, torque_delay=0.0, cutoff=0.0 if used.filtered else used.cutoff)
    samples = dynamics_samples([piece], pauses=True, preprocessing=used, reach=logs.reach)
    if not samples or len(samples[0].q) < 2:
        return None
    moving = samples[0]
    t = np.arange(len(moving.q)) / FREQUENCY
    return _tensors(t, moving.q, moving.qd, moving.qdd, moving.tau, moving.z, moving.direction)


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
    return _tensors(
        _midpoints(piece.t), _midpoints(piece.q), qd, qdd, tau, z, direction_along(qd, logs.reach)
    )


def _midpoints(x: np.ndarray) -> np.ndarray:
    middle: np.ndarray = (x[1:] + x[:-1]) / 2
    return middle


def _tensors(
    t: np.ndarray,
    q: np.ndarray,
    qd: np.ndarray,
    qdd: np.ndarray,
    tau: np.ndarray,
    z: np.ndarray | None,
    direction: np.ndarray | None,
) -> Motion:
    """Return the motion; friction without a state takes no direction but that of qd."""
    if z is None:
        z = np.zeros((*q.shape, 0))
    if direction is None:
        direction = np.sign(qd)
    arrays = map(np.ascontiguousarray, (t, q, qd, qdd, tau, z, direction))
    return Motion(*map(torch.from_numpy, arrays))


def _trace(which: str, name: str, dynamics: Mapping[str, RigidDynamics], motion: Motion) -> TorqueTrace:
    t, q, qd = motion.t, motion.q, motion.qd
    model: Any = dynamics[MODEL]
    inputs = torch.eye(q.shape[-1], dtype=q.dtype)
    with torch.no_grad():
        if hasattr(model, "input_matrix"):  # gears may stand between a motor and a joint
            inputs = model.input_matrix(q)
        predicted = {}
        for label, predictor in dynamics.items():
            torque = _inverse_dynamics(predictor, motion)
            predicted[label] = (inputs @ torque.unsqueeze(-1)).squeeze(-1)
        measured = (inputs @ motion.tau.unsqueeze(-1)).squeeze(-1)
        gravity = torch.as_tensor(model.gravity(q))
        parts = {
            "inertia": (torch.as_tensor(model.mass_matrix(q)) @ motion.qdd.unsqueeze(-1)).squeeze(-1),
            "Coriolis": torch.as_tensor(model.nonlinear_effects(q, qd)) - gravity,
            "gravity": gravity,
            "friction": torch.as_tensor(
                model.friction_torque(q, qd, *known_past(model, motion.z, motion.direction))
            ),
        }
    energy = _energy(t, qd, measured, predicted[MODEL], parts)
    stride = -(-len(t) // TUNING.samples)
    return TorqueTrace(
        which,
        name,
        series(t[::stride]),
        rows(q[::stride]),
        rows(qd[::stride]),
        rows(measured[::stride]),
        _thinned(predicted, stride),
        _thinned(parts, stride),
        {label: series(work[::stride]) for label, work in energy.items()},
    )


def _thinned(torques: Mapping[str, Tensor], stride: int) -> dict[str, Rows]:
    return {label: rows(torque[::stride]) for label, torque in torques.items()}


def _energy(
    t: Tensor, qd: Tensor, measured: Tensor, predicted: Tensor, parts: Mapping[str, Tensor]
) -> dict[str, Tensor]:
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
        power = (torque * qd).sum(dim=-1)
        work[name] = torch.cat([power.new_zeros(1), torch.cumulative_trapezoid(power, t)])
    return work
