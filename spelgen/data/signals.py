"""Trajectories -> what can be computed with: gaps found, units doubted, noise filtered with zero phase."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.signal import butter, sosfiltfilt

from spelgen.data.trajectory import QUANTITIES, Trajectory, rate, split_at_gaps
from spelgen.errors import Diagnostic, LogError, SpelgenError, collect

FILTER_ORDER = 4
AUTOMATIC_CUTOFF = 8.0  # [Hz] rigid-body motion of an arm lies below, drive ripple and quantisation above
AUTOMATIC_RATE = 50.0  # [Hz] logs sampled more slowly are not oversampled enough to be filtered unasked

SAMPLES_PER_PERIOD = 3


def automatic_cutoff(trajectories: Sequence[Trajectory]) -> float | None:
    """8 Hz when every log is sampled above 50 Hz, as measured logs usually are; otherwise None, no filter."""
    return AUTOMATIC_CUTOFF if all(rate(x) > AUTOMATIC_RATE for x in trajectories) else None


def automatic_spacing(trajectories: Sequence[Trajectory], cutoff: float | None) -> int:
    """Samples from one sample of a window to the next: every one, unless filtered logs are much denser than
    needed.

    What was filtered at `cutoff` is fully described by three samples per period of it.
    """
    if cutoff is None:
        return 1
    return max(1, int(min(rate(x) for x in trajectories) / (SAMPLES_PER_PERIOD * cutoff)))


def low_pass(trajectory: Trajectory, cutoff: float) -> Trajectory:
    """One gap-free piece with q, qd and tau through a zero-phase Butterworth low-pass (order 4, both ways).

    cutoff [Hz]. The filter needs a regular grid: the signals are interpolated (cubic) to the piece's mean
    rate, filtered and interpolated back, so that the result stands at the log's own times. All three go
    through the same filter, so that a linear system's filtered input still explains its filtered output.
    """
    t, samples = trajectory.t, len(trajectory.t)
    mean_rate = (samples - 1) / (t[-1] - t[0])
    if cutoff >= mean_rate / 2:
        raise LogError(
            f"a filter of {cutoff:g} Hz on samples at {mean_rate:.3g} Hz", file=trajectory.file,
            element=f"trajectory {trajectory.name}", expected=f"below {mean_rate / 2:.3g} Hz",
            do="lower or drop the filter",
        )  # fmt: skip
    sections = butter(FILTER_ORDER, cutoff, fs=mean_rate, output="sos")
    grid = np.linspace(t[0], t[-1], samples)
    signals = np.concatenate([trajectory.q, trajectory.qd, trajectory.tau], axis=1)  # (T, 3n)
    padding = min(samples - 1, int(3 * mean_rate / cutoff))  # three periods of the cutoff settle the ends
    filtered = sosfiltfilt(sections, CubicSpline(t, signals)(grid), axis=0, padlen=padding)
    q, qd, tau = np.split(CubicSpline(grid, filtered)(t), 3, axis=1)
    return replace(trajectory, q=q, qd=qd, tau=tau)


def resample(trajectory: Trajectory, frequency: float) -> Trajectory:
    """One gap-free piece at a regular rate [Hz], by linear interpolation."""
    t = np.arange(trajectory.t[0], trajectory.t[-1], 1.0 / frequency)
    q, qd, tau = (_interpolate(t, trajectory.t, getattr(trajectory, name)) for name in QUANTITIES)
    return replace(trajectory, t=t, q=q, qd=qd, tau=tau)


def _interpolate(t: np.ndarray, times: np.ndarray, values: np.ndarray) -> np.ndarray:
    return np.stack([np.interp(t, times, column) for column in values.T], axis=1)


def prepare(trajectories: Sequence[Trajectory], *, shortest: int, cutoff: float | None) -> list[Trajectory]:
    """Gap-free pieces of at least `shortest` samples, filtered at cutoff [Hz] if one is given.

    Raises LogError when a trajectory holds no piece that long.
    """
    prepared: list[Trajectory] = []
    errors: list[SpelgenError] = []
    for trajectory in trajectories:
        pieces = [x for x in split_at_gaps(trajectory) if len(x.t) >= shortest]
        if not pieces:
            errors.append(_too_short(trajectory, shortest))
        prepared += pieces if cutoff is None else [low_pass(piece, cutoff) for piece in pieces]
    collect(errors)
    return prepared


def _too_short(trajectory: Trajectory, shortest: int) -> LogError:
    longest = max(len(piece.t) for piece in split_at_gaps(trajectory))
    return LogError(
        f"{longest} samples without a gap", file=trajectory.file, element=f"trajectory {trajectory.name}",
        expected=f"at least {shortest}, one window", do="record longer or train with a shorter window",
    )  # fmt: skip


def examine(
    trajectories: Sequence[Trajectory], joints: Sequence[str], joint_types: Sequence[str]
) -> list[Diagnostic]:
    """What is odd about the logs, nothing repaired: gaps, velocities that are not the positions' derivative.

    Raises LogError when revolute joints look recorded in degrees, unless the file declares its units.
    """
    notes = [note for trajectory in trajectories for note in _gaps(trajectory)]
    errors: list[SpelgenError] = []
    for i, (joint, kind) in enumerate(zip(joints, joint_types, strict=True)):
        smells: list[tuple[Trajectory, str]] = []
        doubts: list[tuple[Trajectory, str]] = []
        for trajectory in trajectories:
            slope, agreement = _derivative_check(split_at_gaps(trajectory), i)
            doubtful = kind == "revolute" and not trajectory.declares_units
            smell = _degrees(trajectory.q[:, i], slope, agreement) if doubtful else None
            if smell:
                smells.append((trajectory, smell))
            elif agreement is not None and (agreement < 0.9 or abs(slope - 1) > 0.1):
                doubts.append((trajectory, f"factor is {slope:.3g}, the correlation {agreement:.3g}"))
        if smells:
            errors.append(_degrees_error(joint, smells))
        if doubts:
            first, found = doubts[0]
            message = (
                f"qd is not dq/dt{_counted(doubts)}: the best {found}; "
                "check units, signs and the order of the joints"
            )
            where = f"trajectory {first.name}, joint {joint!r}"
            notes.append(Diagnostic("warning", "velocity-is-no-derivative", where, None, message))
    collect(errors)
    return notes


def _gaps(trajectory: Trajectory) -> list[Diagnostic]:
    pieces = len(split_at_gaps(trajectory))
    if pieces == 1:
        return []
    longest = np.diff(trajectory.t).max()
    message = f"{pieces - 1} gaps in time, up to {longest:.3g} s long; no window crosses one"
    return [Diagnostic("info", "gap", f"trajectory {trajectory.name}", None, message)]


def _counted(found: Sequence[tuple[Trajectory, str]]) -> str:
    """How many trajectories show what the first one of these is told for."""
    others = len(found) - 1
    return f" (and in {others} more trajectories)" if others else ""


def _derivative_check(pieces: Sequence[Trajectory], joint: int) -> tuple[float, float | None]:
    """Least-squares factor and correlation between increments of q and the trapezoidal integral of qd.

    Over ten steps at a time, so that quantisation of q does not hide the agreement. The correlation is None
    where the joint does not move.
    """
    moved, integral = [], []
    for piece in pieces:
        q, qd, dt = piece.q[:, joint], piece.qd[:, joint], np.diff(piece.t)
        area = np.concatenate([[0.0], np.cumsum((qd[1:] + qd[:-1]) / 2 * dt)])
        span = min(10, len(q) - 1)
        moved.append(q[span:] - q[:-span] if span else q[:0])
        integral.append(area[span:] - area[:-span] if span else q[:0])
    x, y = np.concatenate(integral), np.concatenate(moved)
    size = np.linalg.norm(x) * np.linalg.norm(y)
    if size < 1e-12:
        return 1.0, None
    return float(x @ y / (x @ x)), float(x @ y / size)


def _degrees(q: np.ndarray, slope: float, agreement: float | None) -> str | None:
    """Why a revolute joint seems to be recorded in degrees: in a word, the numbers that say so."""
    factor = 180.0 / np.pi
    if agreement is not None and agreement > 0.9 and 0.8 < slope / factor < 1.25:
        return f"q that changes {slope:.3g} times as fast as qd says (180/pi is 57.3)"
    if agreement is not None and agreement > 0.9 and 0.8 < slope * factor < 1.25:
        return f"qd that is {1 / slope:.3g} times as large as q changes (180/pi is 57.3)"
    if np.ptp(q) > 4 * np.pi:
        return f"q from {q.min():.3g} to {q.max():.3g}, more than two turns"
    return None


def _degrees_error(joint: str, smells: Sequence[tuple[Trajectory, str]]) -> LogError:
    first, smell = smells[0]
    return LogError(
        f"{smell}{_counted(smells)}", file=first.file, element=f"trajectory {first.name}, joint {joint!r}",
        expected="radians and rad/s",
        do="convert degrees; if the units are right, say so in the Parquet schema's metadata 'units'",
    )  # fmt: skip
