"""Checks of signals for jumps: outliers, register words, held values, velocities without sign."""

from __future__ import annotations

import numpy as np

from spelgen.labels import counted
from spelgen.logs.joint_signals import Advice, JointSignals, plain_number
from spelgen.logs.jumps import held_samples, is_lost, is_outlier, jumps, read_as_words
from spelgen.logs.rates import shows_accelerations
from spelgen.logs.recording import listed_times, outlier_rows, stale_rows
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


def find_frozen(signals: JointSignals) -> str | Advice | None:
    """Find a position or a velocity that never changes while the other one does, and values that are old for long."""
    from scipy.integrate import cumulative_trapezoid

    t, q, qd = signals.trajectory.t, signals.q, signals.qd
    if np.ptp(qd) == 0 and np.ptp(q) > SIGNALS.drift:
        return f"qd always {qd[0]:g} while q goes from {q.min():.3g} to {q.max():.3g}"
    # by the trapezoidal rule, so that noise of qd about zero has a small integral
    drift = np.abs(cumulative_trapezoid(qd, t)).max(initial=0.0)
    if np.ptp(q) == 0 and drift > SIGNALS.drift:
        return f"q always {q[0]:g} while qd says that it moves by {drift:.3g}"
    for name in signals.measured if "qd" in signals.measured else ():
        rows = np.flatnonzero(stale_rows(name, signals.signal(name), t, q, qd))
        if rows.size:
            value, count = signals.signal(name)[rows[0]], counted(len(rows), "sample")
            message = f"{name} that stays at {value:.4g} while the joint moves, in {count} from t = {t[rows[0]]:.4g} s"
            return Advice(message, {"dropouts": "dropped"})
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
    unit = mapping.unit(name, signals.joint)
    turns: list[float | None] = [None]
    if signals.kind != "prismatic" and name in ("q", "u"):
        # angles without a stated unit may be in degrees
        turns = [2 * np.pi / abs(scale), *([360.0] if unit is None else [])]
    # a lost sample or an outlier has two jumps, unlike a register
    values = values[~(is_outlier(values, smooth=True) if name == "q" else is_lost(values))]
    for turn in turns:
        word = read_as_words((values - offset) / scale, turn)
        if word is None:
            continue
        # commands may jump: they count as words only if decoded commands are close to the positions
        if name == "u":
            q = signals.q[~is_lost(signals.signal("u"))]
            if np.std(word.values * scale + offset - q) > SIGNALS.near_position * np.std(values - q):
                return None
        keys: dict[str, object] = {word.key: {name: plain_number(word.value, 9)}}
        if turn == 360.0 and unit is None:
            unit, keys = "deg", {"units": {name: "deg"}} | keys
        unit = unit or ("as logged" if turn is None else "rad")
        what = (
            "words with a sign bit" if word.key == "sign_bit" else "a register or an angle that starts again"
        )
        message = f"{name} that jumps by {word.value:.6g} ({unit}), {counted(word.jumps, 'time')}: {what}"
        return Advice(message, {"joints": {signals.joint: keys}})
    return None


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


def find_too_rare(signals: JointSignals) -> str | Advice | None:
    """Find held signals from which no acceleration can be computed; arms under servos need none."""
    rate = signals.trajectory.sample_rate
    if signals.trajectory.u is not None or not shows_accelerations(rate):
        return None
    held = {name: held_samples(signals.signal(name)) for name in signals.measured}
    message = find_held(signals)
    if message is None or shows_accelerations(rate / max(held.values())):
        return None
    # positions that are new show the velocities
    is_mended = all(often == 1 for name, often in held.items() if name != "qd")
    return Advice(message, {"velocity": "differentiated"}) if is_mended else message


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
