"""What every step of the way from log files to training windows works on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from spelgen.errors import LogError
from spelgen.listing import Listing

QUANTITIES = ("q", "qd", "tau")
LARGEST = 1e9  # [rad, rad/s, Nm; m, m/s, N] no arm has more
GAP = 4.0  # a step longer than this many median steps is a hole in the recording, not jitter


@dataclass(frozen=True, eq=False, repr=False)
class Trajectory:
    """One uninterrupted recording of an arm with n joints, from lists, NumPy arrays or tensors; kept as float64.

    t: (T,) sample times [s], strictly increasing, not necessarily regular.
    q, qd: (T, n) joint positions and velocities [rad, rad/s; m, m/s for prismatic joints].
    tau: (T, n) joint torques or forces [Nm; N]. In a simulated log tau[k] is held from t[k] to t[k+1]; in a
        measured one it is the torque measured at t[k]. (T, 0) where none was logged, beside commands u.
    u: (T, n) commanded positions [rad; m] of joints that servos move, u[k] held from t[k] to t[k+1]; None of others.
    name: unique among the trajectories that are used together.
    file: where it was read from, None if it was not.
    declares_units: the file itself, or the mapping it was read by, says in what units its columns are.
    Raises LogError where shapes do not fit, a number is not finite or beyond any arm (LARGEST), or times do not
    increase.
    """

    t: np.ndarray
    q: np.ndarray
    qd: np.ndarray
    tau: np.ndarray
    name: str = "trajectory"
    file: Path | None = None
    declares_units: bool = False
    u: np.ndarray | None = None

    def __post_init__(self) -> None:
        for column in ("t", *self.quantities):
            object.__setattr__(self, column, self._numbers(column))
        if self.t.ndim != 1 or not self.t.size:
            raise self._error("t", f"an array of shape {self.t.shape}", "(T,), a time for each sample")
        samples, joints = len(self.t), self.q.shape[1] if self.q.ndim == 2 else "n"
        for column in self.quantities:
            shape = getattr(self, column).shape
            if len(shape) != 2 or shape != (samples, joints):
                wanted = f"({samples}, {joints}), a row for each time and a column for each joint"
                raise self._error(column, f"an array of shape {shape}", wanted)
        for column in ("t", *self.quantities):
            values = getattr(self, column)
            bad = ~np.isfinite(values) if column == "t" else ~(np.abs(values) < LARGEST)
            if bad.any():
                row = int(np.argwhere(bad)[0, 0])
                possible = (
                    f"numbers below {LARGEST:g}" if np.isfinite(values[row]).all() else "finite numbers"
                )
                raise self._error(column, f"{values[row].tolist()} at sample {row}", possible)
        back = np.flatnonzero(np.diff(self.t) <= 0)
        if back.size:
            before, after = self.t[back[0]], self.t[back[0] + 1]
            raise self._error("t", f"{after:g} s after {before:g} s", "increasing times")

    def __len__(self) -> int:
        """Samples."""
        return len(self.t)

    def __getitem__(self, rows: slice) -> Trajectory:
        """The same recording, only these rows."""
        cut = {name: getattr(self, name)[rows] for name in ("t", "tau", *self.quantities)}
        return replace(self, **cut)

    @property
    def quantities(self) -> tuple[str, ...]:
        """What it holds beside times: q, qd, and tau or u."""
        return QUANTITIES if self.u is None else (*QUANTITIES[:2], "u")

    @property
    def duration(self) -> float:
        """From the first sample to the last [s]."""
        return float(self.t[-1] - self.t[0])

    @property
    def sample_rate(self) -> float:
        """Samples per second outside gaps [Hz], from the mean step: the median of jittered steps is biased."""
        steps = np.diff(self.t)
        return float(1.0 / steps[steps <= GAP * np.median(steps)].mean()) if steps.size else 0.0

    def __repr__(self) -> str:
        joints = self.q.shape[1]
        summary = f"{len(self)} samples, {self.duration:.4g} s at {self.sample_rate:.4g} Hz"
        return f"<Trajectory {self.name!r}: {summary}, {joints} joint{'s' * (joints != 1)}>"

    def _repr_html_(self) -> str:
        return trajectory_listing([self]).html()

    def _numbers(self, column: str) -> np.ndarray:
        given: Any = getattr(self, column)
        try:
            if hasattr(given, "detach"):  # a tensor, wherever it is and whatever gradient it has
                given = given.detach().cpu()
            return np.asarray(given, dtype=float)
        except (TypeError, ValueError) as error:
            raise self._error(column, f"{type(given).__name__} ({error})", "an array of numbers") from error

    def _error(self, column: str, got: str, expected: str) -> LogError:
        return LogError(got, file=self.file, element=f"trajectory {self.name}: {column}", expected=expected)


def require_torques(trajectories: Sequence[Trajectory]) -> None:
    """Raise LogError where no torques were logged."""
    for each in trajectories:
        if each.u is not None:
            raise LogError(
                "commanded positions and no torques", file=each.file, element=f"trajectory {each.name}",
                expected="torques", do="arms under position servos are fitted and judged by `train` and `evaluate`",
            )  # fmt: skip


def require_commands(trajectory: Trajectory) -> np.ndarray:
    """Its commanded positions, (T, n). Raises LogError where none were logged."""
    if trajectory.u is None:
        raise LogError(
            "no commanded positions", file=trajectory.file, element=f"trajectory {trajectory.name}",
            expected="u: this arm has position servos",
        )  # fmt: skip
    return trajectory.u


def trajectory_listing(trajectories: Sequence[Trajectory]) -> Listing:
    """Trajectories as a table: samples, duration, sample rate, joints."""
    head = ("trajectory", "samples", "duration", "sample rate", "joints")
    rows = tuple(
        (x.name, str(len(x)), f"{x.duration:.4g} s", f"{x.sample_rate:.4g} Hz", str(x.q.shape[1]))
        for x in trajectories
    )
    return Listing("Trajectories", head, rows)


def require_joints(trajectory: Trajectory, joints: Sequence[str]) -> None:
    """Raise LogError unless the trajectory has a column for each of these joints."""
    found = trajectory.q.shape[1]
    if found != len(joints):
        raise LogError(
            f"{found} joints", file=trajectory.file, element=f"trajectory {trajectory.name}",
            expected=f"{len(joints)}: {', '.join(joints)}",
        )  # fmt: skip


def gap_ends(t: np.ndarray, gap: float = GAP) -> list[int]:
    """Where the gap-free pieces of these times (T,) begin, and T. gap: in median steps."""
    steps = np.diff(t)
    if not steps.size:
        return [0, len(t)]
    return [0, *(np.flatnonzero(steps > gap * np.median(steps)) + 1).tolist(), len(t)]


def split_at_gaps(trajectory: Trajectory, gap: float = GAP) -> list[Trajectory]:
    """The gap-free pieces, in order, all under the trajectory's name."""
    ends = gap_ends(trajectory.t, gap)
    return [trajectory] if len(ends) == 2 else [trajectory[a:b] for a, b in pairwise(ends)]
