"""Checks of the signals of one joint: frozen signals, outliers, undecoded register words, elastic joints.

The apparent inertia of an elastic joint, seen from the motor, increases with frequency up to a resonance. Let a motor
with inertia J_m drive a link with inertia J_l through a spring. The torque component in phase with the acceleration,
divided by the acceleration, is H(f) = J_m + J_l / (1 - (f / f_0)^2), where f_0 is the resonance of the link with a
locked motor. A rigid joint has H(f) = J + c / f^2, where the constant c is due to gravity.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import yaml
from numpy.lib.stride_tricks import sliding_window_view

from spelgen.labels import counted
from spelgen.logs.jumps import (
    FEWEST,
    decoded,
    is_lost,
    is_outlier,
    jump_count,
    jumps,
    read_as_words,
    unwrapped,
)
from spelgen.logs.recording import COMMANDED, listed_times, outlier_rows, stale_rows, travel
from spelgen.logs.trajectory import Trajectory, split_at_gaps
from spelgen.logs.tuning import SIGNALS, shows_accelerations
from spelgen.settings.log_mapping import Decoding


class Advice(NamedTuple):
    """Finding of a check of logs, with the settings of the column mapping that correct the log.

    Attributes:
        message: the finding.
        joint: settings that correct the log for this joint, `logs: {joints: {NAME: ...}}`; empty if there are none.
        keys: settings that correct the log for all joints, `logs: {...}`; empty if there are none.
        is_guess: True if the settings `joint` are uncertain: they are advised only if most joints have the same fault.
    """

    message: str
    joint: Mapping[str, Any] = {}
    keys: Mapping[str, Any] = {}
    is_guess: bool = False


def settings_line(keys: Mapping[str, object]) -> str:
    """Return settings as one line of YAML without the outer braces, for a message."""
    text: str = yaml.safe_dump(dict(keys), default_flow_style=True, sort_keys=False, width=float("inf"))
    return text.strip()[1:-1]


def mapping_line(keys: Mapping[str, object]) -> str:
    """Return the advice, for a message, to write these settings into the group `logs` of the settings file."""
    return f"write '{settings_line(keys)}' under 'logs' in the robot's YAML"


def joint_keys(entries: Mapping[str, Mapping[str, object]], joints: Sequence[str]) -> dict[str, object]:
    """Return the settings for the group `logs` from the settings of single joints: {"joints": {joint: settings}}.

    If all joints have the same units and no other settings, {"units": ...} for the whole log is returned instead.
    entries: {joint: settings}. joints: names of all joints.
    """
    first = next(iter(entries.values()))
    if first.keys() == {"units"} and all(entries.get(joint) == first for joint in joints):
        return dict(first)
    return {"joints": dict(entries)}


def plain_number(value: float, digits: int = 5) -> float:
    """Return a number rounded to `digits` significant digits, as an int if the result is whole, for a settings file."""
    rounded = float(f"{value:.{digits}g}")
    return int(rounded) if rounded.is_integer() else rounded


class JointSignals(NamedTuple):
    """Signals of one joint in one trajectory, the argument of checks that do not need the robot's model.

    Attributes:
        trajectory: the recording of all joints.
        number: index of the joint.
        kind: joint type: "continuous", "revolute" or "prismatic".
        joints: names of all joints.
        factors: (n,) ratio of dq/dt to qd of each joint, 1 for correct units; NaN for joints at rest.
        correlations: (n,) correlation of this joint's dq/dt with the qd of each joint; NaN for joints at rest.
    """

    trajectory: Trajectory
    number: int
    kind: str
    joints: Sequence[str]
    factors: np.ndarray
    correlations: np.ndarray

    @property
    def q(self) -> np.ndarray:
        """Positions of the joint (T,) [rad, m]."""
        return self.trajectory.q[:, self.number]

    @property
    def qd(self) -> np.ndarray:
        """Velocities of the joint (T,) [rad/s, m/s]."""
        return self.trajectory.qd[:, self.number]

    @property
    def is_at_rest(self) -> bool:
        """True if the joint does not move in the trajectory; its q may have noise."""
        return bool(np.ptp(self.q) <= SIGNALS.rest_range)

    @property
    def turns(self) -> bool:
        """True if the joint can rotate without limit, or by more than two turns."""
        return self.kind == "continuous" or bool(self.trajectory.mapping.word("period", "q", self.joint))

    @property
    def is_whole(self) -> bool:
        """True if all positions of the joint are whole numbers, as counts of an encoder are."""
        return bool((self.q == self.q.round()).all())

    @property
    def measured(self) -> tuple[str, ...]:
        """Names of the measured signals to check: "q", "tau" and, if logged, "qd".

        For logs of position commands, and for logs without torques, only "q" is checked.
        """
        if self.trajectory.u is None and self.trajectory.tau.size:
            return self.trajectory.mapping.quantities
        return ("q",)

    @property
    def step(self) -> float:
        """Median time step between samples [s]; 0 for a single sample."""
        return self.trajectory.step

    @property
    def joint(self) -> str:
        """Name of the joint."""
        return self.joints[self.number]

    def signal(self, quantity: str) -> np.ndarray:
        """Return the joint's signal "q", "qd", "tau" or "u", (T,); an empty array if it was not logged."""
        values = self.trajectory.column(quantity)
        return values[:, self.number] if values.size else np.zeros(0)

    def raw(self, quantity: str) -> np.ndarray:
        """Return the joint's signal "q", "qd", "tau" or "u" as logged, (T,): without the mapping's unit and offset."""
        mapping = self.trajectory.mapping
        values = self.signal(quantity) - mapping.offset(quantity, self.joint)
        return values / mapping.scale(quantity, self.joint)

    @property
    def factor(self) -> float:
        """Ratio of dq/dt to qd of this joint, 1 for correct units; NaN for a joint at rest."""
        return float(self.factors[self.number])

    @property
    def correlation(self) -> float:
        """Correlation of this joint's dq/dt with its own qd."""
        return float(self.correlations[self.number])


def is_factor(value: float, unit: float) -> bool:
    """Return True if a measured ratio `value` of dq/dt to qd equals a conversion factor `unit` within 25 %."""
    # The ratio is inexact because velocities are noisy. A tolerance of 25 % is unambiguous, since conversion factors,
    # such as 57.3 for q in degrees and qd in rad/s, differ from each other by more.
    return 0.8 < value / unit < 1.25


def find_frozen(signals: JointSignals) -> str | Advice | None:
    """Return a finding if a signal is frozen while the joint moves: constant q or qd, or repeated old values.

    Other signals of the joint show that it moves: the commands of a position servo, otherwise q and qd.
    """
    # `motion` [rad, m] is a threshold. A constant qd is frozen if the difference of q and the integral of qd changes by
    # more than `motion`. A constant q is frozen if the integral of qd changes by more than `motion`.
    t, q, qd, u, motion = signals.trajectory.t, signals.q, signals.qd, signals.signal("u"), 0.05
    if np.ptp(qd) == 0 and np.ptp(q - qd * (t - t[0])) > motion:
        return f"qd always {qd[0]:g} while q goes from {q.min():.3g} to {q.max():.3g}"
    # A constant q is compared with the integral of qd and not with qd, because the integral averages the noise of qd.
    drift = np.abs(travel(t, qd)).max(initial=0.0)
    if np.ptp(q) == 0 and drift > motion:
        return f"q always {q[0]:g} while qd says that it moves by {drift:.3g}"
    if np.ptp(q) == 0 and u.size and np.ptp(u) > COMMANDED:
        return f"q always {q[0]:g} while its command goes from {u.min():.3g} to {u.max():.3g}"
    # If qd and dq/dt are proportional with a factor far from 1, a wrong unit explains their difference, and stale
    # values are not searched.
    is_other_unit = signals.correlation > SIGNALS.agreement and not 0.25 < signals.factor < 4
    logged = qd if "qd" in signals.measured else np.zeros(0)
    for name in signals.measured if u.size or not is_other_unit else ():
        rows = np.flatnonzero(stale_rows(name, signals.signal(name), t, q, logged, u))
        if rows.size:
            value, count = signals.signal(name)[rows[0]], counted(len(rows), "sample")
            message = f"{name} that stays at {value:.4g} while the joint moves, in {count} from t = {t[rows[0]]:.4g} s"
            # If half or more of the samples are stale, the column is no measurement: dropping these samples is not
            # advised.
            return Advice(message, keys={"dropouts": "dropped"} if len(rows) < len(t) / 2 else {})
    return None


def find_dropouts(signals: JointSignals) -> str | None:
    """Return a message about the first signal of the joint with lost samples or outliers; None if there is none."""
    for name in (*signals.measured, "u") if signals.signal("u").size else signals.measured:
        values = signals.signal(name)
        rows = np.flatnonzero(outlier_rows(name, values, signals.q))
        # A joint at rest has small outliers of its motion, such as 1e-6 rad: they have no effect.
        if rows.size and not (signals.is_at_rest and name != "tau" and np.ptp(values) < 0.05):
            first, sound = rows[0], np.setdiff1d(np.arange(len(values)), rows)
            size = values[first] - values[sound[np.abs(sound - first).argmin()]]
            what = (
                "falls to 0"
                if values[first] == 0
                else f"deviates from its neighbours by {size:.4g} for a moment"
            )
            times = listed_times(signals.trajectory.t[rows])
            return f"{name} that {what}, in {counted(len(rows), 'sample')}, at t = {times}"
    return None


class WordReading(NamedTuple):
    """Decoding of the register words of a signal.

    Attributes:
        key: setting of the mapping that decodes the signal, "period" or "sign_bit".
        size: value of this setting, in the unit of the log.
        in_degrees: True if the angle is probably in degrees: the mapping states no unit, and `size` is 360 times a
            power of two.
    """

    key: Decoding
    size: float
    in_degrees: bool


def find_words(signals: JointSignals) -> Advice | None:
    """Return a finding if signals of the joint consist of undecoded register words or of wrapped angles.

    Register words are the raw integers of a drive's register, see the module `jumps`. The finding has the settings that
    decode all such signals of the joint.
    """
    mapping, joint, q = signals.trajectory.mapping, signals.joint, signals.q
    readings, units = dict[str, WordReading](), dict[str, str]()
    for name in signals.trajectory.quantities:
        reading = _shared_reading(signals, name)
        if reading is None:
            continue
        values = decoded(signals.raw(name), reading.key, reading.size)
        in_si = values * mapping.scale(name, joint) + mapping.offset(name, joint)
        # Commands may have genuine jumps. A decoding of commands is therefore accepted only if it brings the commands
        # closer to the measured positions.
        if name == "u" and np.std(in_si - q) > 0.3 * np.std(signals.signal("u") - q):
            continue
        q = in_si if name == "q" else q
        readings[name] = reading
        if reading.in_degrees:
            units[name] = "deg"
            speed = float(np.std(np.diff(values))) / signals.step
            if name == "q" and is_factor(speed, float(np.std(signals.qd)) or np.inf):
                units["qd"] = "deg/s"
    if not readings:
        return None
    keys: dict[str, object] = {"units": units} if units else {}
    # The advised line, such as `period: {...}`, replaces the joint's line of the same key in the mapping. It therefore
    # repeats the sign bits or periods that the mapping states for other signals of the joint.
    for key in dict.fromkeys(reading.key for reading in readings.values()):
        stated = {name: mapping.word(key, name, joint) for name in signals.trajectory.quantities}
        sizes = {name: size for name, size in stated.items() if size}
        sizes |= {name: reading.size for name, reading in readings.items() if reading.key == key}
        keys[key] = {name: plain_number(size, 9) for name, size in sizes.items()}
    return Advice(_words_text(signals, readings), keys)


def _words_text(signals: JointSignals, readings: Mapping[str, WordReading]) -> str:
    """Return the message of `find_words` about signals that are register words: the size and number of their jumps.

    Register words are the raw integers of a drive's register, which overflow or have a sign bit. readings: {name of a
    signal, such as "q": the decoding of its words}.
    """
    (name, reading), *others = readings.items()
    raw = signals.raw(name)
    values, what = unwrapped(raw, reading.size), "a register or an angle that starts again"
    if reading.key == "sign_bit":
        values, what = decoded(raw, reading.key, reading.size), "words with a sign bit"
    # Jumps of the logged words are counted without outliers. The outliers are detected in the decoded signal, because
    # among words with a sign bit a genuine 0 looks like a lost sample.
    count = jump_count(raw[~is_outlier(values, smooth=name == "q")], reading.size)
    is_angle = name in ("q", "u") and signals.kind != "prismatic"
    unit = signals.trajectory.mapping.unit(name, signals.joint) or ("rad" if is_angle else "as logged")
    size = f"{reading.size:.6g} ({'deg' if reading.in_degrees else unit})"
    also = "".join(f", and {other}" for other, _ in others)
    return f"{name} that jumps by {size}, {counted(count, 'time')}{also}: {what}"


def find_jumps(signals: JointSignals) -> str | None:
    """Return a message if the position of the joint jumps, for example between joined recordings."""
    sound = ~is_outlier(signals.q, smooth=True)
    t, q = signals.trajectory.t[sound], signals.q[sound]
    # A step is no jump if both neighbouring steps have at least a third of its size. Such steps are a fast motion, for
    # example of a motor before its gear.
    steps = np.pad(np.abs(np.diff(q)), 1)
    rows = np.array([k for k in jumps(t, q) if 3 * min(steps[k], steps[k + 2]) < steps[k + 1]], int)
    if not rows.size:
        return None
    size = q[rows[0] + 1] - q[rows[0]]
    count = counted(len(rows), "time")
    return f"q that jumps by {size:.4g} between two samples, {count}, at t = {listed_times(t[rows])}"


def _shared_reading(signals: JointSignals, name: str) -> WordReading | None:
    """Return the decoding of a signal of the joint as register words; None if it does not consist of such words.

    Register words are the raw integers of a drive's register: they overflow at a period, or have a bit for the sign. A
    joint with a single jump, or with noise about the value of overflow, may suggest a wrong decoding. The registers of
    all joints have the same type, so the decodings found for all joints are tried, the most frequent first. A decoding
    is returned if it was found for this joint, or if it removes more than half of the jumps of this joint.

    name: signal, "q", "qd", "tau" or "u".
    """
    present, raw = _reading(signals, name), signals.raw(name)
    # Decodings that were found for other joints are tried only if this signal has a jump, by more than 40 % of its
    # range. In a signal of two samples nothing is a jump: its only step always equals its range.
    if len(raw) < 3 or not (np.abs(np.diff(raw)) > 0.4 * np.ptp(raw)).any():
        return present
    numbers = [k for k in range(len(signals.joints)) if k != signals.number]
    readings = Counter([present, *(_reading(signals._replace(number=k), name) for k in numbers)])
    for reading, _ in readings.most_common():
        if reading is None:
            continue
        is_possible = np.ptp(raw) < 1.01 * reading.size if reading.key == "period" else raw.min() >= 0
        signal_and_decoded = raw, decoded(raw, reading.key, reading.size)
        jumps_of_both = [np.count_nonzero(abs(np.diff(x)) > 0.4 * reading.size) for x in signal_and_decoded]
        if reading == present or (is_possible and jumps_of_both[1] < 0.5 * jumps_of_both[0]):
            return reading
    return None


def _reading(signals: JointSignals, name: str) -> WordReading | None:
    """Return the decoding of a signal as register words (see `_shared_reading`); None if no decoding fits.

    The size of the signal's jumps shows the period at which the words overflow, or the value of their sign bit.
    """
    mapping, values = signals.trajectory.mapping, signals.signal(name)
    if len(values) < FEWEST:
        return None
    turns: list[float | None] = [None]
    if signals.kind != "prismatic" and name in ("q", "u"):
        # `turns`: candidates for one revolution in the unit of the log; angles without a stated unit may be in degrees.
        has_unit = mapping.unit(name, signals.joint) is not None
        turns = [2 * np.pi / abs(mapping.scale(name, signals.joint)), *([] if has_unit else [360.0])]
    # The decoding is derived from the jumps of the signal, which have the size of the period or of the sign bit. Lost
    # samples and outliers cause jumps of other sizes, so they are removed first.
    is_valid = ~(is_outlier(values, smooth=True) if name == "q" else is_lost(values))
    for turn in turns:
        word = read_as_words(signals.raw(name)[is_valid], turn)
        if word is not None:
            # Without a stated unit, the angle is in degrees if the period or sign bit is 2^k revolutions of 360.
            is_power = np.isclose(np.log2(word.value / 360) % 1, [0, 1], atol=1e-6).any()
            in_degrees = len(turns) > 1 and bool(is_power)
            return WordReading(word.key, plain_number(word.value, 12), in_degrees)
    return None


def find_elastic(signals: JointSignals) -> str | None:
    """Return a message if the apparent inertia of the joint shows the resonance of an elastic gear or belt.

    The apparent inertia H(f) at the frequency f is the torque component in phase with the acceleration, divided by the
    acceleration. An elastic joint has H(f) = J_m + J_l / (1 - (f / f_0)^2), with the inertias J_m of the motor and J_l
    of the link and the resonance f_0 [Hz]; a rigid joint has H(f) = J + c / f^2, where c is due to gravity.
    """
    piece = max(split_at_gaps(signals.trajectory), key=len)
    rate, k = piece.sample_rate, signals.number
    # `length`: number of samples per spectrum. Spectra of 2 s have a frequency resolution of 0.5 Hz.
    length = round(2.0 * rate)
    is_long = shows_accelerations(rate) and len(piece) >= 4 * length
    if not (is_long and piece.tau.size and np.ptp(piece.tau[:, k])):
        return None
    frequency, inertia = _apparent_inertia(piece.qd[:, k], piece.tau[:, k], rate, length)
    # Fewer than five frequency bands do not determine the two inertias (motor, link) and the resonance.
    if len(frequency) < 5:
        return None
    ones = np.ones_like(frequency)
    rigid, _ = _relative_error([ones, frequency**-2.0], inertia)
    candidates = []
    # Candidates for the resonance range from 3 Hz, below which friction with hysteresis acts as a spring, up to 1.5
    # times the highest excited frequency. A higher resonance does not change the apparent inertia noticeably.
    for resonance in np.geomspace(3.0, max(3.0, 1.5 * frequency[-1]), 120):
        # The apparent inertia H(f) is fitted after multiplication by 1 - (f / f_0)^2: the pole of H at the resonance
        # f_0 would otherwise give a frequency band close to f_0 too much weight.
        factor = 1 - (frequency / resonance) ** 2
        error, (motor, link) = _relative_error([factor, ones], factor * inertia)
        # Solutions in which the link has less than a tenth of the motor's inertia are rejected: the resonance of such a
        # link would not be visible in the motor's torque.
        if motor > 0 and link > 0.1 * motor:
            candidates.append((error, resonance, motor, link))
    # RMS errors of the two models are errors of the apparent inertia, relative to its RMS. A joint counts as elastic if
    # the error of the rigid model is at least 10 %, and the error of the elastic model is at most 6 % and at most half
    # the rigid model's. With these thresholds there is no false alarm for the recorded arms, which are rigid.
    if rigid < 0.1 or not candidates or min(candidates)[0] > min(0.06, rigid / 2):
        return None
    _, resonance, motor, link = min(candidates)
    # A rigid model counts as valid up to the frequency f at which the apparent inertia H(f) is 10 % above H(0).
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
    """Return frequencies (B,) [Hz] and apparent inertias (B,) [kg m^2, kg] of the B coherent frequency bands.

    The apparent inertia is the torque component in phase with the acceleration, divided by the acceleration. A band is
    coherent if its torque is nearly proportional to the acceleration.

    Args:
        qd: (T,) velocity [rad/s, m/s].
        tau: (T,) torque [Nm, N].
        rate: sample rate [Hz].
        length: number of samples of a segment of the averaged spectra; segments overlap by half.
    """
    # [Hz] Range of the spectra: below 0.9 Hz gravity and friction dominate; links of arms resonate at 3 to 30 Hz.
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
    # A band is coherent if the squared in-phase coherence of torque and acceleration is above 0.85. Bands with less
    # than 0.1 % of the acceleration power of the strongest band are excluded, too: their apparent inertia, the ratio of
    # torque to acceleration, would be noise.
    coherent = together**2 > 0.85 * moved * driven
    coherent &= moved > 1e-3 * moved.max(initial=0.0)
    return means[coherent], together[coherent] / moved[coherent]


def _relative_error(columns: Sequence[np.ndarray], values: np.ndarray) -> tuple[float, np.ndarray]:
    """Return the RMS residual of a least-squares fit divided by the RMS of `values`, and the coefficients (C,).

    columns: C columns of the regressor, each (B,) for B frequency bands. values: (B,) dependent variable.
    """
    matrix = np.stack(columns, axis=1)
    x = np.linalg.lstsq(matrix, values, rcond=None)[0]
    return float(np.linalg.norm(matrix @ x - values) / np.linalg.norm(values)), x
