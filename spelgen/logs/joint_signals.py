"""Signals of one joint in one trajectory, and checks of them: outliers, register words, held values, elastic joints.

The apparent inertia of an elastic joint at the motor increases with frequency up to a resonance. For a motor with
inertia J_m that drives a link with inertia J_l by a spring, the ratio of the torque in phase with the acceleration to
the acceleration is H(f) = J_m + J_l / (1 - (f / f_0)^2), with the resonance f_0 of the link at a locked motor. A rigid
joint has H = J + c / f^2, with a constant c due to gravity.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import yaml
from numpy.lib.stride_tricks import sliding_window_view

from spelgen.labels import counted
from spelgen.logs.jumps import is_lost, is_outlier, jumps, read_as_words
from spelgen.logs.recording import listed_times, outlier_rows, stale_rows
from spelgen.logs.trajectory import Trajectory, split_at_gaps
from spelgen.logs.tuning import SIGNALS, shows_accelerations


class Advice(NamedTuple):
    """Finding of a check, and the keys of the joint and of the group `logs` that remedy it, which are tested."""

    message: str
    joint: Mapping[str, Any] = {}
    keys: Mapping[str, Any] = {}

    @property
    def is_line(self) -> bool:
        """Whether there is a remedy."""
        return bool(self.joint or self.keys)


def settings_line(keys: Mapping[str, object]) -> str:
    """Return keys of the settings as YAML in one line, without the outer braces."""
    text: str = yaml.safe_dump(dict(keys), default_flow_style=True, sort_keys=False, width=float("inf"))
    return text.strip()[1:-1]


def mapping_line(keys: Mapping[str, object]) -> str:
    """Return the advice to write keys of the group `logs`."""
    return f"write '{settings_line(keys)}' under 'logs' in the robot's YAML"


def joint_keys(entries: Mapping[str, Mapping[str, object]], joints: Sequence[str]) -> dict[str, object]:
    """Return the keys of joints for the group `logs`; a unit that is equal at all joints becomes a unit of the log."""
    first = next(iter(entries.values()))
    if first.keys() == {"units"} and all(entries.get(joint) == first for joint in joints):
        return dict(first)
    return {"joints": dict(entries)}


def plain_number(value: float, digits: int = 5) -> float:
    """Return a number rounded to some digits; an integer if it is one."""
    rounded = float(f"{value:.{digits}g}")
    return int(rounded) if rounded.is_integer() else rounded


class JointSignals(NamedTuple):
    """Signals of one joint in one trajectory: the subject of the checks without the robot.

    q, qd: (T,). factor: ratio of dq/dt to qd; NaN for a joint at rest. correlations: of dq/dt with qd of each joint;
    NaN for a joint at rest.
    """

    trajectory: Trajectory
    number: int
    kind: str
    joints: Sequence[str]
    q: np.ndarray
    qd: np.ndarray
    factor: float
    correlations: Sequence[float]

    @property
    def turns(self) -> bool:
        """Whether the joint can turn without limit."""
        return self.kind == "continuous" or bool(self.trajectory.mapping.word("period", "q", self.joint))

    @property
    def measured(self) -> tuple[str, ...]:
        """Names of the measured quantities: without commands, and without differentiated velocities."""
        if self.trajectory.u is None and self.trajectory.tau.size:
            return self.trajectory.mapping.quantities
        return ("q",)

    @property
    def step(self) -> float:
        """Median time between samples [s]; 0 for a single sample."""
        steps = np.diff(self.trajectory.t)
        return float(np.median(steps)) if steps.size else 0.0

    @property
    def joint(self) -> str:
        """Name of the joint."""
        return self.joints[self.number]

    def signal(self, quantity: str) -> np.ndarray:
        """Return "q", "qd", "tau" or "u" of the joint, (T,); (0,) if it was not logged."""
        values = self.trajectory.column(quantity)
        return values[:, self.number] if values.size else np.zeros(0)

    @property
    def correlation(self) -> float:
        """Correlation of qd and dq/dt."""
        return self.correlations[self.number]

    def changes_by(self, unit: float) -> bool:
        """Return True if dq/dt is this multiple of qd, which indicates a wrong unit."""
        return self.correlation > SIGNALS.agreement and is_factor(self.factor, unit)


def is_factor(value: float, unit: float) -> bool:
    """Return True if a factor equals the factor of a unit within a tolerance."""
    # within this ratio a measured factor is the factor of a unit
    return 0.8 < value / unit < 1.25


def find_frozen(signals: JointSignals) -> str | Advice | None:
    """Find a position or a velocity that never changes while the other one does, and values that are old for long."""
    from scipy.integrate import cumulative_trapezoid

    # [rad, m] above this integral of qd a constant q is frozen, and the reverse
    t, q, qd, motion = signals.trajectory.t, signals.q, signals.qd, 0.05
    if np.ptp(qd) == 0 and np.ptp(q) > motion:
        return f"qd always {qd[0]:g} while q goes from {q.min():.3g} to {q.max():.3g}"
    # by the trapezoidal rule, so that noise of qd about zero has a small integral
    drift = np.abs(cumulative_trapezoid(qd, t)).max(initial=0.0)
    if np.ptp(q) == 0 and drift > motion:
        return f"q always {q[0]:g} while qd says that it moves by {drift:.3g}"
    for name in signals.measured if "qd" in signals.measured else ():
        rows = np.flatnonzero(stale_rows(name, signals.signal(name), t, q, qd))
        if rows.size:
            value, count = signals.signal(name)[rows[0]], counted(len(rows), "sample")
            message = f"{name} that stays at {value:.4g} while the joint moves, in {count} from t = {t[rows[0]]:.4g} s"
            return Advice(message, keys={"dropouts": "dropped"})
    return None


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
        words = _find_words(signals, name)
        if words is not None:
            return words
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
            if np.std(word.values * scale + offset - q) > 0.3 * np.std(values - q):
                return None
        keys: dict[str, object] = {word.key: {name: plain_number(word.value, 9)}}
        if turn == 360.0 and unit is None:
            unit, keys = "deg", {"units": {name: "deg"}} | keys
        unit = unit or ("as logged" if turn is None else "rad")
        what = (
            "words with a sign bit" if word.key == "sign_bit" else "a register or an angle that starts again"
        )
        message = f"{name} that jumps by {word.value:.6g} ({unit}), {counted(word.jumps, 'time')}: {what}"
        return Advice(message, keys)
    return None


def find_elastic(signals: JointSignals) -> str | None:
    """Find joints whose torques show the resonance of an elastic gear or belt."""
    piece = max(split_at_gaps(signals.trajectory), key=len)
    rate, k = piece.sample_rate, signals.number
    # a segment of 2 s: its inverse is the resolution in frequency
    length = round(2.0 * rate)
    is_long = shows_accelerations(rate) and len(piece) >= 4 * length
    if not (is_long and piece.tau.size and np.ptp(piece.tau[:, k])):
        return None
    frequency, inertia = _apparent_inertia(piece.qd[:, k], piece.tau[:, k], rate, length)
    # fewer bands do not determine two constants and a resonance
    if len(frequency) < 5:
        return None
    ones = np.ones_like(frequency)
    rigid, _ = _relative_error([ones, frequency**-2.0], inertia)
    candidates = []
    # a resonance up to 1.5 times the excited frequencies is visible
    for resonance in np.geomspace(frequency[0], 1.5 * frequency[-1], 120):
        # multiplied by the denominator, so that one band at the resonance does not dominate
        factor = 1 - (frequency / resonance) ** 2
        error, (motor, link) = _relative_error([factor, ones], factor * inertia)
        # a smaller link has no visible resonance
        if motor > 0 and link > 0.1 * motor:
            candidates.append((error, resonance, motor, link))
    # smallest relative error of the rigid model, and largest one of the elastic model, of the apparent inertia: with
    # these no recorded arm shows a resonance
    if rigid < 0.1 or not candidates or min(candidates)[0] > min(0.06, rigid / 2):
        return None
    _, resonance, motor, link = min(candidates)
    # up to this frequency the apparent inertia differs from its value at rest by less than 10 %
    share = 0.1 * (motor + link) / link
    valid = resonance * float(np.sqrt(share / (1 + share)))
    unit = "kg" if signals.kind == "prismatic" else "kg m^2"
    return (
        f"elastic joint: the inertia that its torque shows, {motor + link:.3g} {unit}, grows with frequency, with a "
        f"resonance at {resonance:.2g} Hz; a model of rigid bodies is valid below {valid:.2g} Hz"
    )


def _apparent_inertia(
    qd: np.ndarray, tau: np.ndarray, rate: float, length: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return frequencies (B,) [Hz] and apparent inertias (B,), the in-phase ratios of torque to acceleration, of
    coherent bands.

    Args:
        qd: (T,) velocity [rad/s, m/s].
        tau: (T,) torque [Nm, N].
        rate: sample rate [Hz].
        length: samples of a segment; segments overlap by half.
    """
    # [Hz] below, gravity and friction dominate; links of arms have resonances between 3 and 30 Hz
    lowest, highest = 0.9, 30.0
    frequency = np.fft.rfftfreq(length, 1 / rate)
    band = (frequency >= lowest) & (frequency <= min(highest, rate / 3))
    frequency = frequency[band]
    segments = sliding_window_view(np.stack([qd, tau]), length, axis=1)[:, :: length // 2]
    segments = (segments - segments.mean(axis=2, keepdims=True)) * np.hanning(length)
    velocity, torque = np.fft.rfft(segments, axis=2)[..., band]
    acceleration = velocity * (2j * np.pi * frequency)
    power = np.stack([np.abs(acceleration) ** 2, np.abs(torque) ** 2]).sum(axis=1)
    cross = (acceleration.conj() * torque).sum(axis=0).real
    edges = np.geomspace(lowest, frequency[-1], 25)
    firsts = np.unique(np.searchsorted(frequency, edges))
    (moved, driven), together = np.add.reduceat(power, firsts, axis=1), np.add.reduceat(cross, firsts)
    means = np.add.reduceat(frequency, firsts) / np.diff(np.append(firsts, len(frequency)))
    # torque in phase with the acceleration, in bands that the motion excites
    coherent = together**2 > 0.85 * moved * driven
    coherent &= moved > 1e-3 * moved.max(initial=0.0)
    return means[coherent], together[coherent] / moved[coherent]


def _relative_error(columns: Sequence[np.ndarray], values: np.ndarray) -> tuple[float, np.ndarray]:
    """Return the RMS residual of least squares relative to the RMS of the values (B,), and the coefficients (C,)."""
    matrix = np.stack(columns, axis=1)
    x = np.linalg.lstsq(matrix, values, rcond=None)[0]
    return float(np.linalg.norm(matrix @ x - values) / np.linalg.norm(values)), x
