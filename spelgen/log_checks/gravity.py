"""Tell whether logged torques move with gravity, joint by joint, and whether all together act against inertia."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import orth

from spelgen.arm.arm import Arm
from spelgen.dynamics.regressor import regressor, urdf_parameters
from spelgen.identification.drive_hints import make_problem
from spelgen.identification.drive_samples import DriveSamples
from spelgen.logs.trajectory import Trajectory, split_at_gaps
from spelgen.settings.tuning.identification import IdentificationTuning
from spelgen.settings.tuning.log_checks import LogCheckTuning

TUNING = LogCheckTuning()
MOVING = IdentificationTuning().moving


@dataclass(frozen=True, eq=False)
class StateSamples:
    """Hold evenly thinned samples of logs, each (S, n); tau are joint torques."""

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
    """Return samples of one trajectory, accelerations by differences within gap-free pieces. inputs: G, (n, n)."""
    pieces = [piece for piece in split_at_gaps(trajectory) if len(piece) > 2]
    if not pieces:
        return StateSamples(*np.zeros((4, 0, trajectory.q.shape[1])))
    stride = -(-sum(map(len, pieces)) // TUNING.gravity_samples)
    columns = []
    for piece in pieces:
        qdd = np.gradient(piece.qd, piece.t, axis=0)
        columns.append([x[::stride] for x in (piece.q, piece.qd, qdd, piece.tau @ inputs.T)])
    return StateSamples(*map(np.concatenate, zip(*columns, strict=True)))


def fit_gravity(arm: Arm, samples: Sequence[StateSamples]) -> list[GravityFit]:
    """Return by joint what gravity explains of the torques of these samples."""
    q, qd, qdd, tau = _thinned(samples)
    # fewer cannot tell gravity from friction
    if len(q) < TUNING.gravity_samples / 4:
        return [GravityFit()] * q.shape[1]
    still = np.zeros_like(q)
    rows = regressor(arm, q, still, still)  # (S, n, 10 B)
    has_inertials = any(body.inertia for body in arm.bodies)
    load = rows @ urdf_parameters(arm) if has_inertials else None
    # beside friction and the joint's own inertia, which move with gravity in a slow swing
    fits = []
    for joint in range(q.shape[1]):
        speed = qd[:, joint]
        coulomb = np.tanh(speed / MOVING)
        motion = np.stack([np.ones(len(q)), speed, coulomb, qdd[:, joint]], axis=1)
        fits.append(_fit(tau[:, joint], motion, rows[:, joint], None if load is None else load[:, joint]))
    return fits


def find_opposed_inertia(arm: Arm, samples: Sequence[StateSamples], speeds: np.ndarray) -> str | None:
    """Find torques that all have the opposite sign: by least squares the mass matrix then is negative.

    speeds: C, (n, n), of the motors. Friction does not tell: a drive may compensate it after its torque was measured.
    """
    q, qd, qdd, tau = _thinned(samples)
    if len(q) < TUNING.gravity_samples / 4 or not np.ptp(tau, axis=0).all():
        return None
    unit = tau.std(axis=0)
    moving = make_problem(arm, DriveSamples(q, qd, qdd, tau), speeds).rows
    steady = make_problem(arm, DriveSamples(q, qd, np.zeros_like(qdd), tau), speeds).rows
    flat = (moving / unit[:, None]).reshape(tau.size, -1)
    parameters = np.linalg.lstsq(flat, (tau / unit).ravel(), rcond=TUNING.dependent)[0]
    inertia = (moving - steady) @ parameters
    if not (inertia.std(axis=0) > TUNING.loaded * unit).any():
        return None
    product = (inertia * qdd).sum(axis=1)  # qdd^T M qdd
    if product.sum() >= -TUNING.opposed * np.abs(product).sum():
        return None
    return "torques of all joints that act against acceleration"


def _thinned(samples: Sequence[StateSamples]) -> list[np.ndarray]:
    """Return q, qd, qdd and tau of all trajectories together, each (S, n)."""
    signals = []
    for name in ("q", "qd", "qdd", "tau"):
        values = np.concatenate([getattr(x, name) for x in samples])
        signals.append(values[:: -(-len(values) // TUNING.all_gravity_samples) or 1])
    return signals


def _fit(tau: np.ndarray, motion: np.ndarray, columns: np.ndarray, load: np.ndarray | None) -> GravityFit:
    """Fit torques (S,) beside columns of motion by columns of gravity. load: the URDF's gravity torque, (S,)."""
    remainder = _without(motion, tau)
    gravity = _without(motion, columns)
    largest = max(1.0, float(np.abs(columns).max(initial=0.0)))
    gravity = gravity[:, np.linalg.norm(gravity, axis=0) > TUNING.dependent * largest * np.sqrt(len(tau))]
    # a vertical axis, or a motor that was off
    if not gravity.shape[1] or _is_rounding(remainder, tau):
        return GravityFit()
    unexplained = _without(gravity, remainder)
    explained = 1.0 - float(unexplained @ unexplained) / float(remainder @ remainder)
    if load is None:
        return GravityFit(explained)
    own_load = _without(motion, load)
    if _is_rounding(own_load, load):
        return GravityFit(explained, relative_deviation=0.0)
    product, square = float(own_load @ remainder), float(own_load @ own_load)
    correlation = product / float(np.sqrt(square) * np.sqrt(remainder @ remainder))
    return GravityFit(explained, product / square, correlation, float(load.std()) / float(tau.std()))


def _is_rounding(remainder: np.ndarray, values: np.ndarray) -> bool:
    """Whether what is left of values is no more than rounding: of a constant torque, say."""
    return float(np.linalg.norm(remainder)) <= TUNING.dependent * float(np.linalg.norm(values))


def _without(columns: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return what of the values (S,) or (S, K) no combination of the columns (S, C) explains."""
    basis = orth(columns, rcond=TUNING.dependent)
    remainder: np.ndarray = values - basis @ (basis.T @ values)
    return remainder
