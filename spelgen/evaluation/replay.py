"""Arms that position servos move, judged by replaying commands: whole logs from their start, and windows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import torch

from spelgen.dynamics.servo_rollout import STEP, replayed
from spelgen.errors import Diagnostic
from spelgen.evaluation.names import MODEL
from spelgen.fitting.linear_servo import LinearServos
from spelgen.logs.commands import delayed_commands, steps_between
from spelgen.logs.smoothing import velocities
from spelgen.logs.trajectory import Trajectory, split_at_gaps

LATE, LINEAR = "delayed command", "linear servo"
AHEAD = 1.0  # s, of a window


@dataclass(frozen=True)
class ReplayErrors:
    """Of one predictor, root mean squares over time [rad, m]: by trajectory (over joints too), the mean of these, by
    joint over all trajectories.
    """

    trajectories: dict[str, float]
    mean: float
    joints: tuple[float, ...]


@dataclass(frozen=True)
class Replay:
    """What was replayed, and how wrong each predictor was."""

    name: str
    errors: dict[str, ReplayErrors]


Part = tuple[Trajectory, slice]
Missed = tuple[Trajectory, np.ndarray]
"""A log, and predicted less measured positions after each of its intervals, (K, n)."""


class Replayed(Protocol):
    """A baseline that follows commands. about: what it is, and how it was fitted."""

    @property
    def about(self) -> str: ...

    def positions(self, parts: Sequence[Part], q: np.ndarray, qd: np.ndarray) -> list[np.ndarray]:
        """After each interval of each part of a log (K, n), from q and qd (parts, n), under the log's commands."""


def replays(
    model: Any,
    logs: Sequence[Trajectory],
    linear: LinearServos | None,
    notes: list[Diagnostic],
    baselines: Mapping[str, Replayed],
) -> tuple[tuple[Replay, ...], list[Missed]]:
    """Of the model, baselines and, where they are known, linear servos: whole logs, and windows of `AHEAD`, one after
    another; and what the model misses of whole logs.
    """
    pieces = [x for log in logs for x in split_at_gaps(log) if len(x) > 2]
    whole = [(x, slice(0, len(x))) for x in pieces]
    windows = [
        (x, slice(a, a + span))
        for x in pieces
        for span in [round(AHEAD * x.sample_rate) + 1]
        for a in range(0, len(x) - span + 1, span - 1)
    ]
    if linear is None:
        message = "no linear servos to compare with: they are fitted by `train`"
        notes.append(Diagnostic("info", "no-linear-servos", "logs", None, message))
    for name, each in baselines.items():
        notes.append(Diagnostic("info", "baseline", "logs", None, f"{name}: {each.about}"))
    if not baselines:
        message = (
            "no actuators of MuJoCo to compare with: `spelgen train` fits them where MuJoCo is installed"
        )
        notes.append(Diagnostic("info", "no-position-actuators", "logs", None, message))
    wrong = _wrong(model, whole, linear, baselines, still=True)
    found = [Replay("whole log", _summaries(whole, wrong))]
    if windows:
        errors = _summaries(windows, _wrong(model, windows, linear, baselines, still=False))
        found.append(Replay(f"windows of {AHEAD:g} s", errors))
    return tuple(found), [*zip(pieces, wrong[MODEL], strict=True)]


def _wrong(
    model: Any,
    parts: Sequence[Part],
    linear: LinearServos | None,
    baselines: Mapping[str, Replayed],
    *,
    still: bool,
) -> dict[str, list[np.ndarray]]:
    """By predictor, of each part (K, n). still: each part starts at rest, else with the velocity measured there."""
    wrong = {MODEL: _of_model(model, parts, still)}
    for name, each in baselines.items():
        found = each.positions(parts, *_starts(parts, still))
        wrong[name] = [q - x.q[rows][1:] for q, (x, rows) in zip(found, parts, strict=True)]
    if linear is not None:
        wrong[LINEAR] = _of_linear(linear, parts, still)
        late = [delayed_commands(x, rows, linear.late, 1)[:, 0] for x, rows in parts]
        wrong[LATE] = [u - x.q[rows][1:] for u, (x, rows) in zip(late, parts, strict=True)]
    return wrong


def _summaries(parts: Sequence[Part], wrong: Mapping[str, list[np.ndarray]]) -> dict[str, ReplayErrors]:
    names = [x.name for x, _ in parts]
    return {predictor: _summary(names, errors) for predictor, errors in wrong.items()}


def _summary(names: Sequence[str], errors: Sequence[np.ndarray]) -> ReplayErrors:
    joined = {
        name: np.concatenate([x for each, x in zip(names, errors, strict=True) if each == name])
        for name in dict.fromkeys(names)
    }
    by_name = {name: float(np.sqrt(np.square(x).mean())) for name, x in joined.items()}
    joints = np.sqrt(np.square(np.concatenate([*joined.values()])).mean(axis=0))
    return ReplayErrors(by_name, float(np.mean([*by_name.values()])), tuple(joints.tolist()))


def _starts(parts: Sequence[Part], still: bool) -> tuple[np.ndarray, np.ndarray]:
    q = np.stack([x.q[rows.start] for x, rows in parts])
    if still:
        return q, np.zeros_like(q)
    measured = {id(x): velocities(x) for x, _ in parts}
    return q, np.stack([measured[id(x)][rows.start] for x, rows in parts])


def _of_model(model: Any, parts: Sequence[Part], still: bool) -> list[np.ndarray]:
    """Errors (K, n) of each part; all run beside each other, the shorter ones on and on."""
    q, qd = _starts(parts, still)
    steps = max(steps_between(x, STEP) for x, _ in parts)
    delay, longest = float(model.servo.delay), max(rows.stop - rows.start for _, rows in parts) - 1
    commands = [delayed_commands(x, rows, delay, steps) for x, rows in parts]
    held = [np.pad(u, ((0, longest - len(u)), (0, 0), (0, 0)), mode="edge") for u in commands]
    times = [
        np.pad(dt, (0, longest - len(dt)), mode="edge") for dt in (np.diff(x.t[rows]) for x, rows in parts)
    ]
    arrays = (q, qd, np.stack(held), np.stack(times))
    found = replayed(model, *(torch.from_numpy(x) for x in arrays)).numpy()
    return [each[: len(u)] - x.q[rows][1:] for each, u, (x, rows) in zip(found, commands, parts, strict=True)]


def _of_linear(linear: LinearServos, parts: Sequence[Part], still: bool) -> list[np.ndarray]:
    q, qd = _starts(parts, still)
    found = []
    for k, (x, rows) in enumerate(parts):
        predicted = [
            linear.positions(
                joint, q[k : k + 1, joint], qd[k : k + 1, joint],
                delayed_commands(x, rows, delay, 1)[None, :, 0, joint], float(np.diff(x.t[rows]).mean()),
            )[0]
            for joint, delay in enumerate(linear.delay)
        ]  # fmt: skip
        found.append(np.stack(predicted, axis=1) - x.q[rows][1:])
    return found
