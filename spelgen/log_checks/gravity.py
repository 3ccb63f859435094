"""Fit of the URDF's gravity torque to logged torques, for each joint separately."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import orth

from spelgen.arm.arm import Chain
from spelgen.dynamics.regressor_dynamics import regressor, urdf_parameters
from spelgen.log_checks.tuning import TUNING
from spelgen.logs.trajectory import Trajectory, split_at_gaps
from spelgen.logs.tuning import SAMPLES

MOVING = SAMPLES.moving


@dataclass(frozen=True)
class GravityFit:
    """Gravity in the torque of one joint, after removal of friction and of the inertia torque of its own acceleration.

    explained: fraction (0 to 1) of the remaining variance that gravity explains, for the best inertial parameters;
    None if gravity never loads the joint, if the torque is constant, or for too few samples. factor: least-squares
    ratio of the torque to the URDF's gravity torque. correlation: of these two. relative_deviation: standard deviation
    of the URDF's gravity torque, divided by the torque's.
    """

    explained: float | None = None
    factor: float | None = None
    correlation: float | None = None
    relative_deviation: float | None = None


def state_samples(trajectory: Trajectory, inputs: np.ndarray) -> np.ndarray:
    """Return q, qd, qdd and joint torques at evenly spaced samples of one trajectory, (4, S, n).

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
    """Return evenly spaced samples (4, S, n) of all trajectories together."""
    motion = np.concatenate(samples, axis=1)
    return motion[:, :: -(-motion.shape[1] // TUNING.all_gravity_samples) or 1]


def fit_gravity(arm: Chain, motion: np.ndarray) -> list[GravityFit]:
    """Return the fit of gravity per joint. motion: samples (4, S, n)."""
    q, qd, qdd, tau = motion
    # for fewer samples gravity and friction are confounded
    if len(q) < TUNING.gravity_samples / 4:
        return [GravityFit()] * q.shape[1]
    still = np.zeros_like(q)
    rows = regressor(arm, q, still, still)  # (S, n, 10 B)
    load = rows @ urdf_parameters(arm)
    # friction and the joint's own inertia are correlated with gravity in a slow swing: they are removed
    friction = np.stack([np.ones_like(q), qd, np.tanh(qd / MOVING), qdd], axis=2)
    fits = []
    for joint in range(q.shape[1]):
        signals = np.column_stack([tau[:, joint], load[:, joint], rows[:, joint]])
        fits.append(_fit(signals, friction[:, joint]))
    return fits


def _fit(signals: np.ndarray, friction: np.ndarray) -> GravityFit:
    """Return the fit of a torque. signals: (S, 2 + K), the torque, the URDF's gravity torque, and its K columns."""
    remainders = _without(friction, signals)
    lengths = np.linalg.norm(remainders, axis=0)
    # the residual of a constant torque consists of rounding errors
    is_rounding = lengths <= TUNING.dependent * np.linalg.norm(signals, axis=0)
    largest = max(1.0, float(np.abs(signals[:, 2:]).max(initial=0.0)))
    is_seen = lengths[2:] > TUNING.dependent * largest * np.sqrt(len(signals))
    # gravity does not act about a vertical axis; a motor that is off has no torque
    if is_rounding[0] or not is_seen.any():
        return GravityFit()
    torque, load = remainders[:, 0], remainders[:, 1]
    unexplained = _without(remainders[:, 2:][:, is_seen], torque)
    explained = 1.0 - float(unexplained @ unexplained) / float(torque @ torque)
    if is_rounding[1]:
        return GravityFit(explained, relative_deviation=0.0)
    product = float(load @ torque)
    return GravityFit(
        explained=explained,
        factor=product / float(load @ load),
        correlation=product / float(lengths[0] * lengths[1]),
        relative_deviation=float(signals[:, 1].std() / signals[:, 0].std()),
    )


def _without(columns: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the residual of the values (S,) or (S, K) after projection onto the columns (S, C)."""
    basis = orth(columns, rcond=TUNING.dependent)
    return np.asarray(values - basis @ (basis.T @ values))
