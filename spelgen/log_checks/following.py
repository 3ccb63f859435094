"""Measure how joints follow commanded positions: correlations, delays, and distances between the two."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from spelgen.logs.commands import delayed_commands
from spelgen.logs.filtering import derivative
from spelgen.logs.trajectory import Trajectory, require_commands, split_at_gaps
from spelgen.settings.tuning.identification import IdentificationTuning
from spelgen.settings.tuning.servo import ServoLogTuning

TUNING = ServoLogTuning()
MOVING = IdentificationTuning().moving
DELAYS = (
    np.arange(TUNING.earliest_delay, TUNING.latest_delay + 1e-9, TUNING.delay_step).round(9) + 0.0
)  # no -0
NO_DELAY = int(np.argmin(np.abs(DELAYS)))
FILTER_SAMPLES = 12  # the shortest piece that the derivative's polynomial has room in


@dataclass(frozen=True)
class JointFollowing:
    """Say how a joint follows its command; None where it cannot be said.

    lag: by which positions come after commands [s]. tracking_rms: root mean square of u, delayed by the lag, less q
    [rad, m]. steady_state_error: nine tenths of the distances u - q are smaller while both rest. saturated: fraction of
    the time that kp (u - q) is beyond the effort limit.
    """

    lag: float | None
    tracking_rms: float
    steady_state_error: float | None
    saturated: float | None


@dataclass(frozen=True, eq=False)
class Following:
    """Hold how n joints follow their commands at each of the D `DELAYS`.

    moves: (n,) whether the command moves. correlation, gain: (D, n, n) of the command of one joint with the position of
    another, and how far that moves by the command. joints: by joint.
    """

    moves: np.ndarray
    correlation: np.ndarray
    gain: np.ndarray
    joints: list[JointFollowing]


def best_delay(correlation: np.ndarray, command: int, position: int) -> int:
    """Return the index among `DELAYS` at which the command of one joint is most like the position of another."""
    return int(np.argmax(np.abs(correlation[:, command, position])))


def measure_following(logs: Sequence[Trajectory], saturation: np.ndarray) -> Following | None:
    """Measure n joints over recordings; None where none is long enough.

    saturation: (n,) distances from the command at which torque is at its limit; infinite where that is not known.
    """
    pieces: list[Trajectory] = []
    for log in logs:
        pieces += split_at_gaps(log, shortest=FILTER_SAMPLES)
    if not pieces:
        return None
    q = np.concatenate([_midpoints(piece.q) for piece in pieces])
    commands = np.concatenate([require_commands(piece)[:-1] for piece in pieces])
    correlation, gain = np.zeros((2, len(DELAYS), len(saturation), len(saturation)))
    tracking_rms = np.zeros((len(DELAYS), len(saturation)))
    # means differ by the static error, which is no matter of delay
    q_centred = q - q.mean(axis=0)
    for k, delay in enumerate(DELAYS.tolist()):
        delayed = [delayed_commands(piece, slice(0, len(piece)), delay, 1)[:, 0] for piece in pieces]
        u = np.concatenate(delayed)
        u_centred, u_std = u - u.mean(axis=0), u.std(axis=0)
        covariance = u_centred.T @ q_centred / len(u)
        correlation[k] = covariance / np.maximum(np.outer(u_std, q.std(axis=0)), 1e-6)
        gain[k] = covariance / np.maximum(u_std**2, 1e-12)[:, None]
        tracking_rms[k] = np.sqrt(np.mean((u - q) ** 2, axis=0))
    moves = commands.std(axis=0) > TUNING.idle_command
    saturated = np.mean(np.abs(commands - q) > saturation, axis=0)
    joints = []
    for joint, error in enumerate(_steady_state_errors(pieces)):
        delay_index = best_delay(correlation, joint, joint) if moves[joint] else NO_DELAY
        joints.append(
            JointFollowing(
                lag=float(DELAYS[delay_index]) if moves[joint] else None,
                tracking_rms=float(tracking_rms[delay_index, joint]),
                steady_state_error=error,
                saturated=float(saturated[joint]) if np.isfinite(saturation[joint]) else None,
            )
        )
    return Following(moves, correlation, gain, joints)


def _steady_state_errors(pieces: Sequence[Trajectory]) -> list[float | None]:
    """Return by joint nine tenths of the distances from the command while both rest; None where they never do."""
    distances, rests = [], []
    for piece in pieces:
        u = require_commands(piece)[:-1]
        velocity = np.gradient(derivative(piece.q, piece.sample_rate, 0), piece.t, axis=0)[1:]
        span = max(1, round(TUNING.rest_time * piece.sample_rate))
        resting = (u == np.roll(u, span, axis=0)) & (np.abs(velocity) < MOVING)
        resting[:span] = False
        rests.append(resting)
        distances.append(np.abs(u - _midpoints(piece.q)))
    errors: list[float | None] = []
    for distance, resting in zip(np.concatenate(distances).T, np.concatenate(rests).T, strict=True):
        # not the largest: where an arm leans on something it may be anywhere
        errors.append(float(np.quantile(distance[resting], 0.9)) if resting.any() else None)
    return errors


def _midpoints(x: np.ndarray) -> np.ndarray:
    """Return values in the middle between samples, where delayed commands are."""
    return np.asarray((x[1:] + x[:-1]) / 2)
