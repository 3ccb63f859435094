"""Checks of signals for jumps: outliers, register words, held values, velocities without sign."""

from __future__ import annotations

import numpy as np

from spelgen.labels import counted
from spelgen.logs.joint_signals import Advice, JointSignals
from spelgen.logs.jumps import held_samples, is_lost, is_outlier, jumps, read_as_words
from spelgen.logs.rates import shows_accelerations
from spelgen.logs.recording import listed_times, outlier_rows
from spelgen.logs.tuning import SIGNALS


def find_dropouts(signals: JointSignals) -> str | None:
    """Find lost samples and outliers."""
    for name in signals.measured:
        values = signals.signal(name)
        rows = np.flatnonzero(outlier_rows(name, values))
        if rows.size:
            first = rows[0]
            size = values[first] - values[max(first - 1, 0)]
            what = "falls to 0" if values[first] == 0 else f"deviates from its neighbours by {size:.4g}"
            times = listed_times(signals.trajectory.t[rows])
            return f"{name} that {what} for a moment, in {counted(len(rows), 'sample')}, at t = {times}"
    return None


def find_jumps(signals: JointSignals) -> str | Advice | None:
    """Find signals that jump: undecoded register words, wrapped angles, joined recordings."""
    for name in signals.trajectory.quantities:
        found = _find_words(signals, name)
        if found is not None:
            return found
    sound = ~is_outlier(signals.q, smooth=True)
    t, q = signals.trajectory.t[sound], signals.q[sound]
    rows = jumps(t, q)
    if not rows.size:
        return None
    size = q[rows[0] + 1] - q[rows[0]]
    count = counted(len(rows), "time")
    return f"q that jumps by {size:.4g} between two samples, {count}, at t = {listed_times(t[rows])}"


def _find_words(signals: JointSignals, name: str) -> Advice | None:
    """Find undecoded register words, or wrapped angles, in "q", "qd", "tau" or "u" of the joint."""
    mapping, values = signals.trajectory.mapping, signals.signal(name)
    scale, offset = mapping.scale(name, signals.joint), mapping.offset(name, signals.joint)
    turn = None if signals.kind == "prismatic" or name not in ("q", "u") else 2 * np.pi / abs(scale)
    # a lost sample or an outlier has two jumps, unlike a register
    values = values[~(is_outlier(values, smooth=True) if name == "q" else is_lost(values))]
    word = read_as_words((values - offset) / scale, turn)
    if word is None:
        return None
    # commands may jump: they count as words only if decoded commands are close to the positions
    if name == "u":
        q = signals.q[~is_lost(signals.signal("u"))]
        if np.std(word.values * scale + offset - q) > SIGNALS.near_position * np.std(values - q):
            return None
    unit = mapping.unit(name, signals.joint) or ("as logged" if turn is None else "rad")
    size, count = float(f"{word.value:.9g}"), counted(word.jumps, "time")
    what = "words with a sign bit" if word.key == "sign_bit" else "a register or an angle that starts again"
    line = f"joints: {{{signals.joint}: {{{word.key}: {{{name}: {size:.9g}}}}}}}"
    return Advice(
        f"{name} that jumps by {size:.6g} ({unit}), {count}: {what}",
        f"write '{line}' under 'logs' in the robot's YAML",
    )


def find_held(signals: JointSignals) -> str | None:
    """Find signals whose values are held over several rows."""
    rate = signals.trajectory.sample_rate
    for name in signals.measured:
        often = held_samples(signals.signal(name))
        if often > 1:
            return (
                f"{name} that changes {rate / often:.3g} times a second in rows at {rate:.3g} Hz: "
                f"each value lasts {often} samples"
            )
    return None


def find_too_rare(signals: JointSignals) -> str | None:
    """Find held signals from which no acceleration can be computed; arms under servos need none."""
    rate = signals.trajectory.sample_rate
    if signals.trajectory.u is not None or not shows_accelerations(rate):
        return None
    held = [held_samples(signals.signal(name)) for name in signals.measured]
    return None if shows_accelerations(rate / max(held)) else find_held(signals)


def find_unsigned_velocity(signals: JointSignals) -> str | None:
    """Find velocities that are the magnitude of dq/dt."""
    trajectory, qd = signals.trajectory, signals.qd
    lowest, highest = sorted((abs(qd.min()), abs(qd.max())))
    # the velocity noise of a joint at rest has both signs
    if trajectory.mapping.velocity == "differentiated" or lowest > SIGNALS.unsigned * highest or len(qd) < 3:
        return None
    speed = np.gradient(signals.q, trajectory.t)
    backward, forward = sorted((-np.quantile(speed, 0.02), np.quantile(speed, 0.98)))
    if backward < SIGNALS.unsigned * forward or abs(qd).std() == 0:
        return None
    agreement = np.corrcoef(np.abs(speed), np.abs(qd))[0, 1]
    if not agreement > SIGNALS.unsigned_agreement:
        return None
    return f"qd that is the magnitude of dq/dt: from {qd.min():.3g} to {qd.max():.3g} while q goes both ways"
