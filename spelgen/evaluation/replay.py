"""Evaluate arms under position servos by replaying the logged commands over whole logs, and over windows."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from spelgen.baselines.predictor import CommandFollower
from spelgen.dynamics.parameters import without_idle_residuals
from spelgen.dynamics.servo_rollout import replayed
from spelgen.emission.assemble import ArmModel
from spelgen.evaluation.tuning import TUNING
from spelgen.labels import MODEL
from spelgen.logs.filtering import velocities
from spelgen.logs.trajectory import LogRows, Trajectory, delayed_commands, split_at_gaps, steps_between


@dataclass(frozen=True)
class ReplayErrors:
    """RMS errors of the positions that one predictor gives under the commands of test logs [rad, m].

    trajectories: {log: RMS over time and joints}. mean: mean of the errors of all logs. joints: RMS of each joint over
    all logs, (n,).
    """

    trajectories: dict[str, float]
    mean: float
    joints: tuple[float, ...]


@dataclass(frozen=True)
class Replay:
    """Position errors of all predictors on replayed commands.

    name: description of the replayed segments, for example "whole log". errors: {predictor: errors}.
    """

    name: str
    errors: dict[str, ReplayErrors]


PositionErrors = tuple[Trajectory, np.ndarray]
"""A log of K + 1 samples, and predicted minus measured positions after each of its K intervals, (K, n) [rad, m]."""


@dataclass(frozen=True)
class ServoModel:
    """The trained model as a predictor of positions under position commands (`CommandFollower`), like the baselines."""

    model: ArmModel

    def positions(self, segments: Sequence[LogRows], q: np.ndarray, qd: np.ndarray) -> list[np.ndarray]:
        """Return the predicted positions of each segment of a log, (K, n) [rad, m] for a segment of K + 1 samples.

        The model replays the commands of a segment from the state at its first sample, which is not predicted. Segments
        are padded to one length for the rollout; the padding is removed from the result.

        Args:
            segments: (log, slice of its samples) of each segment.
            q: (segments, n) initial positions [rad, m].
            qd: (segments, n) initial velocities [rad/s, m/s].
        """
        # All segments form one batch, because a rollout of many segments takes about as long as a rollout of one. All
        # segments get the same number of integrator steps per interval, the largest number that one of them needs.
        steps = max(steps_between(log) for log, _ in segments)
        lengths = [rows.stop - rows.start - 1 for _, rows in segments]
        commands, intervals = [], []
        for (log, rows), length in zip(segments, lengths, strict=True):
            padding = (0, max(lengths) - length)
            delayed = delayed_commands(log, rows, float(self.model.servo.delay), steps)
            commands.append(np.pad(delayed, (padding, (0, 0), (0, 0)), mode="edge"))
            intervals.append(np.pad(np.diff(log.t[rows]), padding, mode="edge"))
        arrays = (q, qd, np.stack(commands), np.stack(intervals))
        predicted = replayed(self.model, *map(torch.from_numpy, arrays)).numpy()
        return [positions[:length] for positions, length in zip(predicted, lengths, strict=True)]


def replays(
    model: ArmModel,
    logs: Sequence[Trajectory],
    baselines: Mapping[str, CommandFollower],
) -> tuple[tuple[Replay, ...], list[PositionErrors]]:
    """Replay the commands of whole logs, and of consecutive windows of one second, with the model and the baselines.

    Return two results: the errors of all predictors on whole logs and on windows, and the position errors of the model
    along each gap-free segment of the logs.
    """
    pieces = [piece for log in logs for piece in split_at_gaps(log, shortest=3)]
    windows = []
    first_qd = []
    for piece in pieces:
        length, qd = round(TUNING.replay_window * piece.sample_rate) + 1, velocities(piece)
        for start in range(0, len(piece) - length + 1, length - 1):
            windows.append((piece, slice(start, start + length)))
            first_qd.append(qd[start])
    # The model is treated as one of the predictors, so that the same code measures all errors.
    predictors = {MODEL: ServoModel(without_idle_residuals(model)), **baselines}
    # Whole logs are replayed from zero velocity, as they begin at rest. Windows start with the velocity of the log.
    logs_from_rest = [(piece, slice(0, len(piece))) for piece in pieces]
    at_rest = np.zeros((len(pieces), pieces[0].q.shape[1]))
    replay, missed = _replay("whole log", predictors, logs_from_rest, at_rest)
    results = [replay]
    # If all logs are shorter than a window, there are no errors over windows.
    if windows:
        name = f"windows of {TUNING.replay_window:g} s"
        results.append(_replay(name, predictors, windows, np.stack(first_qd))[0])
    return tuple(results), list(zip(pieces, missed, strict=True))


def _replay(
    name: str, predictors: Mapping[str, CommandFollower], segments: Sequence[LogRows], qd: np.ndarray
) -> tuple[Replay, list[np.ndarray]]:
    """Return the errors of all predictors, and the position errors of the model, on replayed segments of logs.

    The position errors are (K, n) [rad, m] for a segment of K + 1 samples; the first sample, the initial state, has no
    error.

    Args:
        name: description of the segments, for example "whole log".
        predictors: {name: predictor of positions}, the model and the baselines.
        segments: (log, slice of its samples) of each segment.
        qd: (segments, n) initial velocities [rad/s, m/s].
    """
    q = np.stack([log.q[rows.start] for log, rows in segments])
    measured = [log.q[rows][1:] for log, rows in segments]
    errors = {}
    for predictor, follower in predictors.items():
        errors[predictor] = list(map(np.subtract, follower.positions(segments, q, qd), measured))
    names = [log.name for log, _ in segments]
    summaries = {predictor: _summary(names, missed) for predictor, missed in errors.items()}
    return Replay(name, summaries), errors[MODEL]


def _summary(names: Sequence[str], errors: Sequence[np.ndarray]) -> ReplayErrors:
    """Return the RMS position errors of one predictor per log and per joint.

    names: name of the log of each segment. errors: position errors of each segment of K + 1 samples, (K, n) [rad, m];
    the first sample, the initial state, has no error.
    """
    by_name: dict[str, list[np.ndarray]] = {}
    # A log with gaps consists of several segments with the same name: their errors are joined.
    for name, error in zip(names, errors, strict=True):
        by_name.setdefault(name, []).append(np.square(error))
    trajectories = {name: float(np.sqrt(np.concatenate(x).mean())) for name, x in by_name.items()}
    joints = np.sqrt(np.square(np.concatenate(errors)).mean(axis=0))
    return ReplayErrors(trajectories, float(np.mean(list(trajectories.values()))), tuple(joints.tolist()))
