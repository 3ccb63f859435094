"""Evaluate arms under position servos by replaying logged commands: over whole logs, and over windows."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from spelgen.baselines.predictor import CommandFollower
from spelgen.dynamics.parameters import without_idle_residuals
from spelgen.dynamics.servo_rollout import replayed
from spelgen.emission.assemble import ArmModel
from spelgen.errors import Diagnostic
from spelgen.evaluation.tuning import TUNING
from spelgen.labels import MODEL
from spelgen.logs.filtering import velocities
from spelgen.logs.trajectory import LogRows, Trajectory, delayed_commands, split_at_gaps, steps_between


@dataclass(frozen=True)
class ReplayErrors:
    """Root mean square position errors of one predictor [rad, m].

    trajectories: by log, over time and joints. mean: mean of these. joints: (n,) over time and all logs.
    """

    trajectories: dict[str, float]
    mean: float
    joints: tuple[float, ...]


@dataclass(frozen=True)
class Replay:
    """Errors of replayed commands per predictor. name: the replayed segments, for example whole logs."""

    name: str
    errors: dict[str, ReplayErrors]


PositionErrors = tuple[Trajectory, np.ndarray]
"""A log, and predicted minus measured positions at the end of each interval, (K, n) [rad, m]."""


class ServoModel:
    """The model as a `CommandFollower`."""

    about = "the model"

    def __init__(self, model: ArmModel) -> None:
        self._model = without_idle_residuals(model)

    def positions(self, parts: Sequence[LogRows], q: np.ndarray, qd: np.ndarray) -> list[np.ndarray]:
        """Return the positions per part, (K, n). All parts run in one batch, in which shorter ones are padded."""
        # one number for all parts, which form one batch; more steps than needed only cost time
        steps = max(steps_between(log) for log, _ in parts)
        lengths = [rows.stop - rows.start - 1 for _, rows in parts]
        commands, intervals = [], []
        for (log, rows), length in zip(parts, lengths, strict=True):
            # the operations of a rollout are small: they cost the same for one part and for many
            padding = (0, max(lengths) - length)
            delayed = delayed_commands(log, rows, float(self._model.servo.delay), steps)
            commands.append(np.pad(delayed, (padding, (0, 0), (0, 0)), mode="edge"))
            intervals.append(np.pad(np.diff(log.t[rows]), padding, mode="edge"))
        arrays = (q, qd, np.stack(commands), np.stack(intervals))
        predicted = replayed(self._model, *map(torch.from_numpy, arrays)).numpy()
        return [positions[:length] for positions, length in zip(predicted, lengths, strict=True)]


def replays(
    model: ArmModel,
    logs: Sequence[Trajectory],
    baselines: Mapping[str, CommandFollower],
    notes: list[Diagnostic],
) -> tuple[tuple[Replay, ...], list[PositionErrors]]:
    """Replay whole logs, and consecutive windows of one second, by the model and the baselines.

    Returns both, and the position errors of the model over whole logs. The baselines are described in `notes`.
    """
    pieces = [piece for log in logs for piece in split_at_gaps(log, shortest=3)]
    windows: list[LogRows] = []
    first_qd: list[np.ndarray] = []
    for piece in pieces:
        length, qd = round(TUNING.replay_window * piece.sample_rate) + 1, velocities(piece)
        for start in range(0, len(piece) - length + 1, length - 1):
            windows.append((piece, slice(start, start + length)))
            first_qd.append(qd[start])
    for name, baseline in baselines.items():
        notes.append(Diagnostic("info", "baseline", "logs", None, f"{name}: {baseline.about}"))
    # the model is one of the predictors: all are measured by the same code
    predictors = {MODEL: ServoModel(model), **baselines}
    # a log begins at rest; a window begins in motion
    logs_from_rest: list[LogRows] = [(piece, slice(0, len(piece))) for piece in pieces]
    at_rest = np.zeros((len(pieces), pieces[0].q.shape[1]))
    replay, missed = _replay("whole log", predictors, logs_from_rest, at_rest)
    results = [replay]
    # logs shorter than a window have no second table
    if windows:
        name = f"windows of {TUNING.replay_window:g} s"
        results.append(_replay(name, predictors, windows, np.stack(first_qd))[0])
    return tuple(results), list(zip(pieces, missed, strict=True))


def _replay(
    name: str, predictors: Mapping[str, CommandFollower], parts: Sequence[LogRows], qd: np.ndarray
) -> tuple[Replay, list[np.ndarray]]:
    """Return the errors per predictor, and the position errors (K, n) of the model on each part.

    qd: (parts, n) initial velocities [rad/s, m/s].
    """
    q = np.stack([log.q[rows.start] for log, rows in parts])
    measured = [log.q[rows][1:] for log, rows in parts]
    errors = {}
    for predictor, follower in predictors.items():
        errors[predictor] = list(map(np.subtract, follower.positions(parts, q, qd), measured))
    names = [log.name for log, _ in parts]
    summaries = {predictor: _summary(names, missed) for predictor, missed in errors.items()}
    return Replay(name, summaries), errors[MODEL]


def _summary(names: Sequence[str], errors: Sequence[np.ndarray]) -> ReplayErrors:
    """Return the errors (K, n) [rad, m] of parts of logs, pooled by the names of the logs."""
    by_name: dict[str, list[np.ndarray]] = {}
    # a log with gaps is several pieces of one name
    for name, error in zip(names, errors, strict=True):
        by_name.setdefault(name, []).append(np.square(error))
    trajectories = {name: float(np.sqrt(np.concatenate(x).mean())) for name, x in by_name.items()}
    joints = np.sqrt(np.square(np.concatenate(errors)).mean(axis=0))
    return ReplayErrors(trajectories, float(np.mean(list(trajectories.values()))), tuple(joints.tolist()))
