"""Measure how joints follow commanded positions: correlations, delays, and distances between the two."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from spelgen.logs.commands import delayed_commands
from spelgen.logs.smoothing import derivative
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


@dataclass(frozen=True, eq=False)
class Following:
    """Hold how n joints follow their commands at each of the D `DELAYS`.

    moves: (n,) whether the command moves. correlation, gain: (D, n, n) of the command of one joint with the position of
    another, and how far that moves by the command. tracking_rms: (D, n) root mean square of u - q [rad, m].
    steady_state_errors: of each joint, the distances u - q while command and joint rest. saturated: (n,) fraction of
    the samples at its torque limit.
    """

    moves: np.ndarray
    correlation: np.ndarray
    gain: np.ndarray
    tracking_rms: np.ndarray
    steady_state_errors: list[np.ndarray]
    saturated: np.ndarray

    def best_delay(self, command: int, position: int) -> int:
        """Return the index among `DELAYS` at which the command of one joint is most like the position of another."""
        return int(np.argmax(np.abs(self.correlation[:, command, position])))


def measure_following(logs: Sequence[Trajectory], saturation: np.ndarray) -> Following:
    """Measure n joints over recordings; saturation: (n,) distances from the command at which torque is at its limit."""
    pieces = []
    for log in logs:
        pieces += split_at_gaps(log, shortest=FILTER_SAMPLES)
    n = len(saturation)
    q = _joined([_midpoints(piece.q) for piece in pieces], n)
    # means differ by the static error, which is no matter of delay
    q_centred = q - _mean(q)
    q_std = np.sqrt(_mean(q_centred**2))
    correlation, gain = np.zeros((2, len(DELAYS), n, n))
    tracking_rms = np.zeros((len(DELAYS), n))
    for k, delay in enumerate(DELAYS.tolist()):
        u = _joined([_commands(piece, delay) for piece in pieces], n)
        u_centred = u - _mean(u)
        u_std = np.sqrt(_mean(u_centred**2))
        covariance = u_centred.T @ q_centred / max(len(u), 1)
        correlation[k] = covariance / np.maximum(np.outer(u_std, q_std), 1e-6)
        gain[k] = covariance / np.maximum(u_std**2, 1e-12)[:, None]
        tracking_rms[k] = np.sqrt(_mean((u - q) ** 2))
        if k == NO_DELAY:
            moves = u_std > TUNING.idle_command
    commands = _joined([require_commands(piece)[:-1] for piece in pieces], n)
    return Following(
        moves=moves,
        correlation=correlation,
        gain=gain,
        tracking_rms=tracking_rms,
        steady_state_errors=_resting_errors(pieces, n),
        saturated=_mean(np.abs(commands - q) > saturation),
    )


def _resting_errors(pieces: Sequence[Trajectory], n: int) -> list[np.ndarray]:
    """Return the distances u - q of each joint while it and its command rest."""
    # a joint that never rests has no error, and an empty array says so
    errors = [[np.zeros(0)] for _ in range(n)]
    for piece in pieces:
        u = require_commands(piece)[:-1]
        velocity = np.gradient(derivative(piece.q, piece.sample_rate, 0), piece.t, axis=0)[1:]
        span = max(1, round(TUNING.rest_time * piece.sample_rate))
        rests = (u == np.roll(u, span, axis=0)) & (np.abs(velocity) < MOVING)
        rests[:span] = False
        command_error = u - _midpoints(piece.q)
        for joint in range(n):
            errors[joint].append(command_error[rests[:, joint], joint])
    return list(map(np.concatenate, errors))


def _commands(piece: Trajectory, delay: float) -> np.ndarray:
    """Return the mean delayed commands between samples, (T - 1, n)."""
    return delayed_commands(piece, slice(0, len(piece)), delay, 1)[:, 0]


def _midpoints(x: np.ndarray) -> np.ndarray:
    """Return values in the middle between samples, where delayed commands are."""
    middle: np.ndarray = (x[1:] + x[:-1]) / 2
    return middle


def _joined(arrays: list[np.ndarray], n: int) -> np.ndarray:
    """Concatenate arrays of n columns, of which there may be none."""
    return np.concatenate([np.zeros((0, n)), *arrays])


def _mean(x: np.ndarray) -> np.ndarray:
    """Return the mean of (T, n) over time, 0 where there are no samples."""
    mean: np.ndarray = x.sum(axis=0) / max(len(x), 1)
    return mean
