"""Tell whether logged torques move with gravity, joint by joint, and whether all together act against inertia."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import orth

from spelgen.arm.arm import Arm
from spelgen.dynamics.regressor import body_chain, regressor, urdf_parameters
from spelgen.identification.drive_hints import drive_rows
from spelgen.logs.trajectory import Trajectory, split_at_gaps
from spelgen.settings.tuning.identification import IdentificationTuning
from spelgen.settings.tuning.log_checks import LogCheckTuning

TUNING = LogCheckTuning()
MOVING = IdentificationTuning().moving


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


def state_samples(trajectory: Trajectory, inputs: np.ndarray) -> np.ndarray:
    """Return q, qd, qdd and joint torques of one trajectory, thinned evenly, (4, S, n).

    Accelerations are differences within gap-free pieces. inputs: G, (n, n).
    """
    pieces = split_at_gaps(trajectory, shortest=3)
    if not pieces:
        return np.zeros((4, 0, trajectory.q.shape[1]))
    stride = -(-sum(map(len, pieces)) // TUNING.gravity_samples)
    motions = []
    for piece in pieces:
        qdd = np.gradient(piece.qd, piece.t, axis=0)
        motions.append(np.stack([piece.q, piece.qd, qdd, piece.tau @ inputs.T])[:, ::stride])
    return np.concatenate(motions, axis=1)


def joined(samples: Sequence[np.ndarray]) -> np.ndarray:
    """Return the samples (4, S, n) of all trajectories together, thinned evenly."""
    motion = np.concatenate(samples, axis=1)
    return motion[:, :: -(-motion.shape[1] // TUNING.all_gravity_samples) or 1]


def fit_gravity(arm: Arm, motion: np.ndarray) -> list[GravityFit]:
    """Return by joint what gravity explains of the torques of these samples, (4, S, n)."""
    q, qd, qdd, tau = motion
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
        friction = np.stack([np.ones(len(q)), speed, coulomb, qdd[:, joint]], axis=1)
        fits.append(_fit(tau[:, joint], friction, rows[:, joint], None if load is None else load[:, joint]))
    return fits


def find_opposed_inertia(arm: Arm, motion: np.ndarray, speeds: np.ndarray) -> str | None:
    """Find torques that all have the opposite sign: by least squares the mass matrix then is negative.

    motion: samples, (4, S, n). speeds: C, (n, n), of the motors. Friction does not tell: a drive may compensate it
    after its torque was measured.
    """
    q, qd, qdd, tau = motion
    if len(q) < TUNING.gravity_samples / 4 or not np.ptp(tau, axis=0).all():
        return None
    unit = tau.std(axis=0)
    chain = body_chain(arm)
    moving = drive_rows(chain, q, qd, qdd, speeds)
    steady = drive_rows(chain, q, qd, np.zeros_like(qdd), speeds)
    flat = (moving / unit[:, None]).reshape(tau.size, -1)
    parameters = np.linalg.lstsq(flat, (tau / unit).ravel(), rcond=TUNING.dependent)[0]
    inertia = (moving - steady) @ parameters
    if not (inertia.std(axis=0) > TUNING.loaded * unit).any():
        return None
    product = (inertia * qdd).sum(axis=1)  # qdd^T M qdd
    if product.sum() >= -TUNING.opposed * np.abs(product).sum():
        return None
    return "torques of all joints that act against acceleration"


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
