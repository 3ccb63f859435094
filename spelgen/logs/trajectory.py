"""Recording of an arm in SI units: the result of reading a log, from which training samples are made."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import TypeVar

import numpy as np

from spelgen.errors import LogError
from spelgen.labels import counted
from spelgen.listing import Listing
from spelgen.logs.fingerprints import smallest_hashes
from spelgen.logs.tuning import TUNING
from spelgen.settings.log_mapping import LogMapping

T = TypeVar("T")

QUANTITIES = ("q", "qd", "tau")
GAP = TUNING.gap
IN_SI = LogMapping()


@dataclass(frozen=True, eq=False, repr=False)
class Trajectory:
    """Recording of an arm with n joints; lists, NumPy arrays and tensors are converted to float64 arrays.

    Attributes:
        t: (T,) sample times [s], strictly increasing, not necessarily regular.
        q: (T, n) joint positions [rad; m for prismatic joints].
        qd: (T, n) joint velocities [rad/s; m/s].
        tau: (T, n) joint torques or forces [Nm; N]. In a simulated log tau[k] is constant from t[k] to t[k+1]; in a
            measured log it is the torque at t[k]. Logs of commands u have no torques: tau is then (T, 0).
        u: (T, n) commanded positions of joints with servos [rad; m], u[k] constant from t[k] to t[k+1]; None without
            servos.
        name: name, unique among the trajectories that are used together.
        file: source of the recording; None if it was not read from a file.
        accepted: codes of checks (see `spelgen.logs.checks`) that are omitted.
        repairs: messages about rows that the reader changed or removed.
        remarks: messages about properties of the log.
        mapping: columns and units of the log.

    Raises LogError for inconsistent shapes, for numbers that are not finite or extremely large, and for times that do
    not increase.
    """

    t: np.ndarray
    q: np.ndarray
    qd: np.ndarray
    tau: np.ndarray
    name: str = "trajectory"
    file: Path | None = None
    accepted: tuple[str, ...] = ()
    u: np.ndarray | None = None
    repairs: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()
    mapping: LogMapping = IN_SI

    def __post_init__(self) -> None:
        columns = ("t", *self.quantities)
        for column in columns:
            # Lists and tensors are converted to arrays. `object.__setattr__` is used, because the dataclass is frozen.
            object.__setattr__(self, column, self._as_array(column))
        if self.t.ndim != 1 or not self.t.size:
            raise self.error(f"an array of shape {self.t.shape}", "(T,), a time for each sample", column="t")
        joints = self.q.shape[1] if self.q.ndim == 2 else "n"
        for column in self.quantities:
            shape = self.column(column).shape
            if shape != (len(self), joints):
                expected = f"({len(self)}, {joints}), a row for each time and a column for each joint"
                raise self.error(f"an array of shape {shape}", expected, column=column)
        for column in columns:
            values, largest = self.column(column), TUNING.latest if column == "t" else TUNING.largest_value
            possible = np.abs(values) < largest  # comparisons with NaN are False, so NaN is an error, too
            if not possible.all():
                row = int(np.argwhere(~possible)[0, 0])
                is_finite = np.isfinite(values[row]).all()
                expected = f"numbers below {largest:g}" if is_finite else "finite numbers"
                raise self.error(f"{values[row].tolist()} at sample {row}", expected, column=column)
        # Time steps of nearly zero are rejected: velocities computed by differentiation would be infinite.
        backward = np.flatnonzero(np.diff(self.t) < TUNING.shortest_step)
        if backward.size:
            k = backward[0]
            raise self.error(f"{self.t[k + 1]:g} s after {self.t[k]:g} s", "increasing times", column="t")

    def __len__(self) -> int:
        """Return the number of samples."""
        return len(self.t)

    def __getitem__(self, rows: slice) -> Trajectory:
        """Return a trajectory that contains only the samples of a slice."""
        u = None if self.u is None else self.u[rows]
        return replace(self, t=self.t[rows], q=self.q[rows], qd=self.qd[rows], tau=self.tau[rows], u=u)

    def differentiated(self, joints: Sequence[int]) -> Trajectory:
        """Return a trajectory in which the velocities of some joints are derivatives of their positions."""
        qd = self.qd.copy()
        for start, end in pairwise(gap_ends(self.t)):
            if end - start > 1:
                qd[start:end, joints] = np.gradient(self.q[start:end][:, joints], self.t[start:end], axis=0)
        return replace(self, qd=qd)

    def column(self, name: str) -> np.ndarray:
        """Return a signal by its name: t (T,), or q, qd, tau or u (T, n); an empty array if u was not logged."""
        values: np.ndarray | None = getattr(self, name)
        return np.zeros(0) if values is None else values

    @property
    def quantities(self) -> tuple[str, ...]:
        """Names of the signals: q, qd, and u for logs of commands, else tau."""
        return QUANTITIES if self.u is None else ("q", "qd", "u")

    @property
    def duration(self) -> float:
        """Time from the first to the last sample [s]."""
        return float(self.t[-1] - self.t[0])

    @cached_property
    def sample_rate(self) -> float:
        """Sample rate outside gaps [Hz], the inverse of the mean time step; 0 for a single sample.

        The mean is used, because jitter would bias the median time step.
        """
        steps = self.regular_steps
        return float(1.0 / steps.mean()) if steps.size else 0.0

    @cached_property
    def step(self) -> float:
        """Median time step between samples [s]; 0 for a single sample."""
        steps = np.diff(self.t)
        return float(np.median(steps)) if steps.size else 0.0

    @cached_property
    def regular_steps(self) -> np.ndarray:
        """Time steps between samples that are no gaps, (steps,) [s]; their mean is the sample interval."""
        steps = np.diff(self.t)
        return steps[steps <= GAP * self.step] if steps.size else steps

    @cached_property
    def fingerprint(self) -> list[int]:
        """Hashes of the samples (see `smallest_hashes`), by which a copy under another name is recognised."""
        return smallest_hashes(self.q, self.tau if self.u is None else self.u)

    def __repr__(self) -> str:
        _, samples, duration, rate, joints = _summary(self)
        return f"<Trajectory {self.name!r}: {samples} samples, {duration} at {rate}, {counted(int(joints), 'joint')}>"

    def _repr_html_(self) -> str:
        return trajectory_listing([self]).html()

    def _as_array(self, column: str) -> np.ndarray:
        values: object = getattr(self, column)
        try:
            if hasattr(values, "detach"):  # NumPy cannot convert a tensor on a GPU or with gradients.
                values = values.detach().cpu()
            if isinstance(values, np.ma.MaskedArray):  # Masked values become NaN; asarray ignores masks.
                return np.ma.filled(values.astype(float), np.nan)
            return np.asarray(values, dtype=float)
        except (TypeError, ValueError) as error:
            got = f"{type(values).__name__} ({error})"
            raise self.error(got, "an array of numbers", column=column) from error

    def error(self, got: str, expected: str, do: str | None = None, column: str = "") -> LogError:
        """Return an error about the trajectory, or about its signal `column`; got, expected, do: see `SpelgenError`."""
        element = f"trajectory {self.name}" + (f": {column}" if column else "")
        return LogError(got, file=self.file, element=element, expected=expected, do=do)


def require_torques(trajectories: Sequence[Trajectory]) -> None:
    """Raise LogError if a trajectory has commanded positions instead of torques."""
    for trajectory in trajectories:
        if trajectory.u is not None:
            do = "arms with position servos have 'input: position' in the YAML beside the URDF; `train` fits them"
            raise trajectory.error("commanded positions and no torques", "torques", do)


def require_commands(trajectory: Trajectory) -> np.ndarray:
    """Return the commanded positions, (T, n). Raises LogError for a trajectory without commands."""
    if trajectory.u is None:
        raise trajectory.error("no commanded positions", "u: this arm has position servos")
    return trajectory.u


def trajectory_listing(trajectories: Sequence[Trajectory]) -> Listing:
    """Return a table of trajectories with the numbers of samples and joints, duration and sample rate."""
    head = ("trajectory", "samples", "duration", "sample rate", "joints")
    return Listing("Trajectories", head, tuple(map(_summary, trajectories)))


def _summary(x: Trajectory) -> tuple[str, ...]:
    joints = str(x.q.shape[1])
    return x.name, str(len(x)), f"{x.duration:.4g} s", f"{x.sample_rate:.4g} Hz", joints


def require_joints(trajectory: Trajectory, joints: Sequence[str]) -> None:
    """Raise LogError if the number of joints in the trajectory differs from the number of names in `joints`."""
    count = trajectory.q.shape[1]
    if count != len(joints):
        raise trajectory.error(f"{count} joints", f"{len(joints)}: {', '.join(joints)}")


def recordings(logs: Trajectory | Iterable[Trajectory], joints: Sequence[str]) -> list[Trajectory]:
    """Return one or several trajectories as a list, after a check of their types and joints.

    Raises LogError for other objects, such as paths, for no trajectories, and for a wrong number of joints.
    """
    trajectories = [logs] if isinstance(logs, Trajectory) else list(logs)
    if not trajectories:
        raise LogError("no trajectory", expected="at least one")
    for trajectory in trajectories:
        if not isinstance(trajectory, Trajectory):
            got = f"{type(logs).__name__} {logs!r:.60}"
            expected = "trajectories: spelgen.read_logs(PATHS, arm) or Trajectory(...)"
            raise LogError(got, element="logs", expected=expected)
        require_joints(trajectory, joints)
    return trajectories


def gap_ends(t: np.ndarray, gap: float = GAP, hole: float = 0.0) -> list[int]:
    """Return the index of the first sample of each gap-free piece of the times t (T,) [s], followed by T.

    A gap is a time step longer than `gap` median steps and longer than `hole` [s].
    """
    steps = np.diff(t)
    # In most recordings the longest step is at most `gap` times the shortest step. There is then no gap, and the
    # median, which takes most of the time, need not be computed.
    if not steps.size or steps.max() <= gap * steps.min():
        return [0, len(t)]
    return [0, *(np.flatnonzero(steps > max(gap * np.median(steps), hole)) + 1).tolist(), len(t)]


def split_at_gaps(
    trajectory: Trajectory, gap: float = GAP, hole: float = 0.0, *, shortest: int = 1
) -> list[Trajectory]:
    """Return the gap-free pieces of a trajectory with at least `shortest` samples, in the order of time.

    Each piece has the name of the trajectory. A gap is a time step longer than `gap` median steps and longer than
    `hole` [s].
    """
    ends = gap_ends(trajectory.t, gap, hole)
    # A trajectory without gaps is returned itself, since a copy would be validated again.
    pieces = [trajectory[start:stop] for start, stop in pairwise(ends)] if len(ends) > 2 else [trajectory]
    return [piece for piece in pieces if len(piece) >= shortest]


def joined_column(trajectories: Sequence[Trajectory], name: str) -> np.ndarray:
    """Return one signal, by its name, of all trajectories concatenated: t (T,), or q, qd, tau or u (T, n)."""
    return np.concatenate([x.column(name) for x in trajectories])


def set_aside(items: Sequence[T], numbers: np.ndarray) -> tuple[list[T], list[T]]:
    """Return two lists: the items whose index is not in `numbers` (k,), and the items whose index is in it."""
    chosen = set(numbers.tolist())
    remaining = [item for k, item in enumerate(items) if k not in chosen]
    return remaining, [item for k, item in enumerate(items) if k in chosen]


def coverage(logs: Sequence[Trajectory]) -> dict[str, object]:
    """Return the motion that logs cover, in JSON form: the duration [s], and ranges and histograms of `q` and `qd`.

    Keys: `seconds`; `q` and `qd` with `low`, `high` and the `counts` of 24 bins for each joint.
    """
    result: dict[str, object] = {"seconds": _rounded(sum(log.duration for log in logs))}
    for name in ("q", "qd"):
        joints = []
        for column in joined_column(logs, name).T:
            counts = np.histogram(column, 24)[0].tolist()
            joints.append({"low": _rounded(column.min()), "high": _rounded(column.max()), "counts": counts})
        result[name] = joints
    return result


def _rounded(value: float) -> float:
    """Return a value rounded to five significant digits."""
    return float(f"{value:.5g}")


LogRows = tuple[Trajectory, slice]
"""Part of a log: the trajectory, and a slice of its rows."""


def steps_between(trajectory: Trajectory, longest: float = 3.4e-3) -> int:
    """Return the number of integration steps per mean sample interval, so that a step is at most ``longest`` [s]."""
    # The default of 3.4 ms was chosen because fits of position servos with longer integration steps gave armatures that
    # were biased by a few per cent.
    return max(1, math.ceil(1 / (trajectory.sample_rate * longest) - 1e-6))


def delayed_commands(trajectory: Trajectory, rows: slice, delay: float, steps: int) -> np.ndarray:
    """Return the commands (K, steps, n) [rad, m], delayed by `delay` [s] and averaged over each integration step.

    `rows` selects K + 1 samples of n joints. Each of the K intervals between them is divided into `steps` integration
    steps of equal length. A command is constant until the next command. The averages are differentiable with respect to
    the delay, unlike the values of a step function at single times.
    """
    samples = trajectory.t[rows]
    earliest, latest = np.searchsorted(trajectory.t, samples[[0, -1]] - delay)
    # With the delay, the motion between the first and the last selected sample depends on the commands between the
    # times samples[0] - delay and samples[-1] - delay. `held_rows` are the H rows of these commands. A command is held
    # until the next row, so the last row before samples[0] - delay is included.
    held_rows = slice(max(0, earliest - 1), latest + 1)
    t, u = trajectory.t[held_rows], require_commands(trajectory)[held_rows]
    # `previous`: (H, n) [rad, m], the command that is held until the time of each of the H rows: the command of the row
    # before.
    previous = np.concatenate([u[:1], u[:-1]])
    # [s] Before the recording, the first command is assumed to have been constant for 1,000 s.
    corners = np.concatenate([t[:1] - 1e3, t])
    integral = np.zeros((len(t) + 1, u.shape[1]))
    integral[1:] = np.cumsum(np.diff(corners)[:, None] * previous, axis=0)
    edges = samples[:-1, None] + np.diff(samples)[:, None] * np.arange(steps) / steps
    edges = np.append(edges.ravel(), samples[-1])
    values = [np.interp(edges - delay, corners, column) for column in integral.T]
    means = np.diff(values) / np.diff(edges)
    return means.T.reshape(len(samples) - 1, steps, -1)
