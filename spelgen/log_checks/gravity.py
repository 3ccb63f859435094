"""Does the logged torque move with gravity? Asked joint by joint, with motion and friction taken out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from spelgen.arm.arm import Arm
from spelgen.dynamics.regressor import regressor, urdf_parameters
from spelgen.logs.trajectory import Trajectory, split_at_gaps

SAMPLES = 400  # of one trajectory
LEAST, MOST = 100, 6000  # of all
COULOMB_SMOOTHING_VELOCITY = 0.02  # [rad/s, m/s]
DEPENDENT = 1e-8


@dataclass(frozen=True, eq=False)
class StateSamples:
    """Evenly thinned samples of logs, each (S, n); tau are joint torques."""

    q: np.ndarray
    qd: np.ndarray
    qdd: np.ndarray
    tau: np.ndarray


@dataclass(frozen=True)
class GravityFit:
    """What gravity has to do with the torque of one joint.

    explained: part of the torque's variance, beside friction and the joint's own acceleration, that some
    inertial values explain as gravity (0..1); None where gravity never loads the joint, where the torque never
    changes, or where there is too little to tell. factor: by what the URDF's gravity torque must be multiplied to
    fit best, correlation: of both, beside the same. relative_deviation: the standard deviation of the URDF's,
    relative to that of the torque; all three None without inertials.
    """

    explained: float | None = None
    factor: float | None = None
    correlation: float | None = None
    relative_deviation: float | None = None


def state_samples(trajectory: Trajectory, inputs: np.ndarray) -> StateSamples:
    """Samples of one trajectory, accelerations by differences within gap-free pieces. inputs: G, (n, n)."""
    pieces = [piece for piece in split_at_gaps(trajectory) if len(piece) > 2]
    every = -(-max(1, sum(map(len, pieces))) // SAMPLES)
    columns = [
        [x[::every] for x in (p.q, p.qd, np.gradient(p.qd, p.t, axis=0), p.tau @ inputs.T)] for p in pieces
    ]
    n = trajectory.q.shape[1]
    joined = [np.concatenate(each) for each in zip(*columns, strict=True)] or [np.zeros((0, n))] * 4
    return StateSamples(*joined)


def fit_gravity(arm: Arm, parts: Sequence[StateSamples]) -> list[GravityFit]:
    """By joint, what gravity explains of the torques of these samples."""
    q, qd, qdd, tau = (
        np.concatenate([getattr(part, name) for part in parts]) for name in ("q", "qd", "qdd", "tau")
    )
    if len(q) < LEAST:
        return [GravityFit()] * q.shape[1]
    every = -(-len(q) // MOST)
    q, qd, qdd, tau = (x[::every] for x in (q, qd, qdd, tau))
    still = np.zeros_like(q)
    rows = regressor(arm, q, still, still)  # (S, n, 10 B)
    parameters = urdf_parameters(arm) if any(body.inertia for body in arm.bodies) else None
    found = []
    for joint in range(q.shape[1]):
        speed = qd[:, joint]
        coulomb = np.tanh(speed / COULOMB_SMOOTHING_VELOCITY)
        beside = np.stack([np.ones(len(q)), speed, coulomb, qdd[:, joint]], axis=1)
        columns = rows[:, joint, :]
        torque = None if parameters is None else columns @ parameters
        found.append(_fit(tau[:, joint], beside, columns, torque))
    return found


def _fit(tau: np.ndarray, beside: np.ndarray, columns: np.ndarray, torque: np.ndarray | None) -> GravityFit:
    left = _without(beside, tau)
    free = _without(beside, columns)
    size = np.linalg.norm(free, axis=0)
    free = free[:, size > DEPENDENT * max(1.0, float(np.abs(columns).max(initial=0.0))) * np.sqrt(len(tau))]
    if not free.shape[1] or _is_rounding(left, tau):
        return GravityFit()
    unexplained = _without(free, left)
    explained = 1.0 - float(unexplained @ unexplained) / float(left @ left)
    if torque is None:
        return GravityFit(explained)
    load = _without(beside, torque)
    if _is_rounding(load, torque):
        return GravityFit(explained, relative_deviation=0.0)
    correlation = float(load @ left) / float(np.sqrt(load @ load) * np.sqrt(left @ left))
    factor = float(load @ left) / float(load @ load)
    return GravityFit(explained, factor, correlation, float(torque.std()) / float(tau.std()))


def _is_rounding(left: np.ndarray, whole: np.ndarray) -> bool:
    """Whether what is left of the whole is no more than rounding: of a constant torque, say."""
    return float(np.linalg.norm(left)) <= DEPENDENT * float(np.linalg.norm(whole))


def _without(columns: np.ndarray, values: np.ndarray) -> np.ndarray:
    """What of the values (S,) or (S, K) no combination of the columns (S, C) explains."""
    u, s, _ = np.linalg.svd(columns, full_matrices=False)
    u = u[:, s > DEPENDENT * s.max(initial=0.0)]
    return values - u @ (u.T @ values)
