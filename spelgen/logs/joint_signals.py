"""Signals of one joint in one trajectory, and checks of them: outliers, register words, held values, elastic joints.

The apparent inertia of an elastic joint at the motor increases with frequency up to a resonance. For a motor with
inertia J_m that drives a link with inertia J_l by a spring, the ratio of the torque in phase with the acceleration to
the acceleration is H(f) = J_m + J_l / (1 - (f / f_0)^2), with the resonance f_0 of the link at a locked motor. A rigid
joint has H = J + c / f^2, with a constant c due to gravity.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from spelgen.labels import counted
from spelgen.logs.jumps import held_samples, is_lost, is_outlier, jumps, read_as_words
from spelgen.logs.recording import listed_times, outlier_rows
from spelgen.logs.trajectory import Trajectory, split_at_gaps
from spelgen.logs.tuning import SIGNALS, shows_accelerations


class Advice(NamedTuple):
    """Finding of a check with a remedy that the check has tested."""

    message: str
    do: str


class JointSignals(NamedTuple):
    """Signals of one joint in one trajectory: the subject of the checks without the robot.

    q, qd: (T,). factor: ratio of dq/dt to qd; NaN for a joint at rest. correlations: of qd with dq/dt of each joint;
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
    # a measured factor within this ratio counts as the factor of the unit
    return 0.8 < value / unit < 1.25


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
    mapping, values, joint = signals.trajectory.mapping, signals.signal(name), signals.joint
    scale, offset = mapping.scale(name, joint), mapping.offset(name, joint)
    turn = None if signals.kind == "prismatic" or name not in ("q", "u") else 2 * np.pi / abs(scale)
    # a lost sample or an outlier has two jumps, unlike a register
    values = values[~(is_outlier(values, smooth=True) if name == "q" else is_lost(values))]
    word = read_as_words((values - offset) / scale, turn)
    if word is None:
        return None
    # commands may jump: they count as words only if decoded commands are close to the positions
    if name == "u":
        q = signals.q[~is_lost(signals.signal("u"))]
        if np.std(word.values * scale + offset - q) > 0.3 * np.std(values - q):
            return None
    unit = mapping.unit(name, joint) or ("as logged" if turn is None else "rad")
    size, count = float(f"{word.value:.9g}"), counted(word.jumps, "time")
    what = "words with a sign bit" if word.key == "sign_bit" else "a register or an angle that starts again"
    line = f"joints: {{{joint}: {{{word.key}: {{{name}: {size:.9g}}}}}}}"
    message = f"{name} that jumps by {size:.6g} ({unit}), {count}: {what}"
    return Advice(message, f"write '{line}' under 'logs' in the robot's YAML")


def find_held(signals: JointSignals) -> str | None:
    """Find signals whose values are held over several rows."""
    rate = signals.trajectory.sample_rate
    for name in signals.measured:
        often = held_samples(signals.signal(name))
        if often > 1:
            rates = f"{rate / often:.3g} times a second in rows at {rate:.3g} Hz"
            return f"{name} that changes {rates}: each value lasts {often} samples"
    return None


def find_too_rare(signals: JointSignals) -> str | None:
    """Find held signals from which no acceleration can be computed; arms under servos need none."""
    rate = signals.trajectory.sample_rate
    if signals.trajectory.u is not None or not shows_accelerations(rate):
        return None
    held = max(held_samples(signals.signal(name)) for name in signals.measured)
    return None if shows_accelerations(rate / held) else find_held(signals)


def find_unsigned_velocity(signals: JointSignals) -> str | None:
    """Find velocities that are the magnitude of dq/dt."""
    # largest velocity of the rarer sign, relative to the largest velocity, of a signal without sign
    trajectory, qd, share = signals.trajectory, signals.qd, 0.05
    lowest, highest = sorted((abs(qd.min()), abs(qd.max())))
    # the velocity noise of a joint at rest has both signs
    if trajectory.mapping.velocity == "differentiated" or lowest > share * highest or len(qd) < 3:
        return None
    speed = np.gradient(signals.q, trajectory.t)
    backward, forward = sorted((-np.quantile(speed, 0.02), np.quantile(speed, 0.98)))
    if backward < share * forward or abs(qd).std() == 0:
        return None
    if not np.corrcoef(np.abs(speed), np.abs(qd))[0, 1] > 0.9:
        return None
    return f"qd that is the magnitude of dq/dt: from {qd.min():.3g} to {qd.max():.3g} while q goes both ways"


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
    kept = (frequency >= lowest) & (frequency <= min(highest, rate / 3))
    frequency = frequency[kept]
    segments = sliding_window_view(np.stack([qd, tau]), length, axis=1)[:, :: length // 2]
    segments = (segments - segments.mean(axis=2, keepdims=True)) * np.hanning(length)
    velocity, torque = np.fft.rfft(segments, axis=2)[..., kept]
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
