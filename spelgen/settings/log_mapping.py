"""Names, units and signs of logged columns: the group `logs` of a settings file, or a separate mapping file.

With `value` the logged number and `unit` the factor to SI units: q = sign * unit * value + offset,
qd = sign * unit * value, tau = sign * gain * unit * value + torque_offset. A commanded position u is converted like q.
Register values of motors, such as signed magnitudes, are first decoded by `sign_bit` and `period`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from itertools import product
from math import pi
from typing import Annotated, Literal

from pydantic import Field, PlainSerializer, ValidationInfo, WrapValidator, field_validator, model_validator

from spelgen.errors import SettingsError
from spelgen.settings.yaml_document import Group, Number, Place, Positive

_MILLI = 1e-3
TIMES = {unit: _MILLI**power for power, unit in enumerate(("s", "ms", "us", "ns"))}
# LENGTHS, SPEEDS and SCALES: {unit that is no SI unit: factor to the SI unit}.
LENGTHS = {"deg": pi / 180, "turns": 2 * pi, "mrad": _MILLI, "mm": _MILLI}
SPEEDS = {f"{name}/s": scale for name, scale in LENGTHS.items()} | {"rpm": 2 * pi / 60}
# 1 kgf is the weight of 1 kg at the standard gravity of 9.80665 m/s^2; datasheets of small servos state kgf cm.
SCALES = {**LENGTHS, **SPEEDS, "mNm": _MILLI, "Ncm": 1e-2, "kgf.cm": 9.80665e-2, "mA": _MILLI}
# Units of `tau` that need a gain: currents, and fractions of a rated torque that the log does not contain.
CURRENTS = ("A", "mA", "percent", "permille")
COUNTS = ("counts", "counts/s")
# Unit of positions in LeRobot's default format: the ends of the calibrated range of a motor are -100 and 100.
NORMALISED = "normalised"
# {quantity: {unit of a log in the form of `plain_unit`: unit of a mapping}}. A unit of a mapping may have a factor:
# positions in "cdeg" have the unit "0.01 deg".
UNIT_NAMES: dict[str, dict[str, str]] = {
    quantity: {name: unit for unit, names in units for name in names.split()}
    for quantity, units in {
        "t": [("s", "s sec secs second seconds"), ("ms", "ms msec millis milliseconds"),
              ("us", "us µs usec micros microseconds"), ("ns", "ns nsec nanos nanoseconds"), ("60 s", "min")],
        "q": [("deg", "deg degs degree degrees grad °"), ("rad", "rad"), ("mrad", "mrad"), ("0.001 deg", "mdeg"),
              ("0.01 deg", "cdeg"), ("counts", "counts ticks pulse pulses cnt inc"), ("0.016666666667 deg", "arcmin"),
              ("turns", "turns turn rev revs revolutions"), ("m", "m"), ("10 mm", "cm"), ("mm", "mm")],
        "qd": [("deg/s", "degps dps"), ("rad/s", "radps"), ("rpm", "rpm 1/min r/min"), ("turns/s", "rps")],
        "tau": [("Nm", "nm"), ("mNm", "mnm"), ("Ncm", "ncm"), ("kgf.cm", "kgfcm kgcm"), ("N", "n"), ("1000 N", "kn"),
                ("A", "a amps ampere"), ("mA", "ma"), ("percent", "% percent"), ("permille", "‰ permille"),
                ("1000 Nm", "knm"), ("1.355817948 Nm", "lbfft"), ("0.112984829 Nm", "lbfin")],
    }.items()
}  # fmt: skip
UNIT_NAMES["qd"] |= {f"{name}/s": f"{unit}/s" for name, unit in UNIT_NAMES["q"].items()}
ONLY = {  # {joint type: units that values of such a joint cannot have}
    "revolute": {"m", "mm", "m/s", "mm/s", "N"},
    "prismatic": {NORMALISED, "rad", "rad/s", "Nm", "mNm", "Ncm", "kgf.cm", *LENGTHS, *SPEEDS}
    - {"mm", "mm/s"},
}

LONGEST_DELAY = 1.0  # [s] Largest magnitude of a delay in the settings.
Delay = Annotated[Number, Field(ge=-LONGEST_DELAY, le=LONGEST_DELAY)]

Accepted = Literal[
    "degrees", "frozen", "time-unit", "dropouts", "jumps", "held-samples", "velocity-without-sign", "no-torques",
    "velocity-is-no-derivative", "torque-sense", "torque-unit", "torque-beyond-drive", "torque-order", "motion-order",
    "joint-sense", "joint-order", "joint-unit", "joint-zero", "joint-delay", "joint-clock", "gravity",
    "gravity-compensated", "torque-changed", "torque-clipped", "torque-without-sign", "torque-copied",
    "torque-unexplained", "normalised",
]  # fmt: skip
"""Codes of errors of `spelgen logs` that a user can accept."""


def _scaled(value: object, validate: Callable[[object], str], info: ValidationInfo) -> str:
    """Return a unit of a mapping in its standard spelling: "degrees" becomes "deg", "0.01 degrees" "0.01 deg".

    value: unit in the settings, with an optional factor. validate: pydantic's check that a unit without factor is
    allowed. info: has the name of the field, which is the quantity ("t", "q", "qd", "tau" or "u").
    """
    text = value if isinstance(value, str) else ""
    match = re.fullmatch(r"((?:\d*\.?\d+(?:e[+-]?\d+)? ?)?)([^\d\s.].*)", text)
    if not match or (match[1] and not float(match[1])):
        return validate(value)
    factor, name = match[1].strip(), match[2]
    # "grad" is a degree in German, and 0.9 degrees in English. A mapping must be unambiguous, so it is an unknown unit
    # here. Drafts of mappings, which are tested with the logs, may read it as degrees.
    plain = "" if name.lower().startswith("grad") else plain_unit(name)
    multiple, _, unit = (mapped_unit(str(info.field_name), plain) or "").rpartition(" ")
    if factor and multiple:
        factor = f"{float(factor) * float(multiple):.9g}"
    return f"{factor or multiple} {validate(unit or name)}".strip()


# pydantic would warn if a field with a Literal type contained another value. A unit with a factor is such a value, so
# units are serialised as plain texts.
_SCALED = WrapValidator(_scaled), PlainSerializer(str, when_used="unless-none")
Time = Annotated[Literal["s", "ms", "us", "ns"], *_SCALED]
Position = Annotated[Literal["rad", "deg", "turns", "mrad", "counts", "normalised", "m", "mm"], *_SCALED]
Velocity = Annotated[
    Literal["rad/s", "deg/s", "turns/s", "mrad/s", "rpm", "counts/s", "m/s", "mm/s"], *_SCALED
]
Effort = Annotated[Literal["Nm", "mNm", "Ncm", "kgf.cm", "N", "A", "mA", "percent", "permille"], *_SCALED]
Decoding = Literal["period", "sign_bit"]
"""Settings of the raw values of registers and wrapped angles."""


def plain_unit(text: str) -> str:
    """Return a unit as written in a log, in lower case, without brackets and signs of products.

    Examples: N·m is nm; deg_s, deg/sec and deg s^-1 are deg/s; 1e-3 N·m is "0.001 nm". In "N·m x1000", the logged
    values are torques in N·m multiplied by 1000: the unit is also "0.001 nm".
    """
    unit = text.strip(" []()").lower().replace("\u00d7", "x")
    number = r"(\d+(?:\.\d+)?(?:e[+-]?\d+)?)"
    match = re.fullmatch(rf"(?P<x>x?) ?{number}(?![\d/]) ?[*x]?(?P<unit>.+)|(.+?) ?[*x] ?{number}", unit)
    factor = ""
    if match:
        unit = match["unit"] or match[4]
        # "Nm x1000" means that logged values are a thousand times as large as in Nm: the factor is 1 / 1000. "0.01 deg"
        # means that logged values are hundredths of a degree: the factor is 0.01.
        size = float(match[2] or match[5])
        factor = f"{1 / size if size > 1 and (match['x'] or match[5]) else size:.9g} "
    unit = re.sub(r"([\s_/]|[\s_]per[\s_])s(ec(ond)?)?(\^?-1|⁻¹)?$", "/s", unit)
    unit = re.sub(r"(/|[\s_]per[\s_])min(utes?)?$", "/min", unit)
    return factor + re.sub(r"[\s.·⋅*-]", "", unit)


def mapped_unit(quantity: str, unit: str) -> str | None:
    """Convert a unit of a log in the form of `plain_unit` to a unit of a mapping; None if the unit is unknown.

    Examples: "degrees" becomes "deg", "0.001 nm" becomes "0.001 Nm", "2 cdeg" becomes "0.02 deg". quantity: "t", "q",
    "qd", "tau" or "u"; a unit of another quantity is unknown.
    """
    factor, _, name = unit.rpartition(" ")
    mapped = UNIT_NAMES["q" if quantity == "u" else quantity].get(name)
    if mapped is None or not factor:
        return mapped
    multiple, _, name = mapped.rpartition(" ")
    return f"{float(factor) * float(multiple or 1):.11g} {name}"


# Velocities per minute, such as mm/min: a sixtieth of the unit per second.
UNIT_NAMES["qd"] |= {f"{x}/min": mapped_unit("qd", f"{1 / 60} {x}/s") or "" for x in UNIT_NAMES["q"]}


def is_unit(unit: str) -> bool:
    """Return True if a text in the form of `plain_unit` is a unit of any quantity."""
    return any(mapped_unit(quantity, unit) for quantity in UNIT_NAMES)


class LogColumns(Group):
    """Names of the columns; `{joint}` is replaced by the joint's `name`, and `{trajectory}` (NPZ) by any text.

    Attributes:
        t: Time.
        trajectory: Name of the trajectory, if a file has several.
        q: Position.
        qd: Velocity.
        tau: Torque.
        u: Commanded position of a position servo.
    """

    t: str = "t"
    trajectory: str = "trajectory"
    q: str = "q_{joint}"
    qd: str = "qd_{joint}"
    tau: str = "tau_{joint}"
    u: str = "u_{joint}"


PLAIN = LogColumns().model_dump()
"""Names of the columns in files that spelgen writes."""


class JointColumns(Group):
    """Names of the columns of one joint, in place of the names in `columns` for all joints.

    Attributes:
        q: Position.
        qd: Velocity.
        tau: Torque.
        u: Commanded position.
    """

    q: str | None = None
    qd: str | None = None
    tau: str | None = None
    u: str | None = None


class JointUnits(Group):
    """Units of the columns of one joint, in place of the `units` of all joints.

    A unit may have a factor: "0.01 deg" for values in hundredths of a degree.

    Attributes:
        q: Position.
        qd: Velocity.
        tau: Torque, force or motor current.
        u: Commanded position; default: the unit of q.
    """

    q: Position | None = None
    qd: Velocity | None = None
    tau: Effort | None = None
    u: Position | None = None


class LogUnits(JointUnits):
    """Units of the times and of the columns of all joints, one per quantity; default: SI units.

    If no unit of positions is set, positions in degrees are reported as an error.

    Attributes:
        t: Time.
    """

    t: Time = "s"


class JointWords(Group):
    """Periods, or sign bits, of the logged signals of one joint, in logged units; default: values are plain numbers.

    A period (setting `period`) is the interval after which logged values wrap around. A sign bit s (`sign_bit`) marks
    negative numbers in values of sign and magnitude: the logged value s + x is the number -x.

    Attributes:
        q: Period or sign bit of positions.
        qd: Period or sign bit of velocities.
        tau: Period or sign bit of torques.
        u: Period or sign bit of commanded positions.
    """

    q: Positive | None = None
    qd: Positive | None = None
    tau: Positive | None = None
    u: Positive | None = None


class JointDelays(Group):
    """Delays of the logged values of one joint relative to the other signals [s]; negative for early values.

    Attributes:
        q: Delay of positions.
        qd: Delay of velocities.
        tau: Delay of torques, in addition to `torque_delay`.
    """

    q: Delay = 0.0
    qd: Delay = 0.0
    tau: Delay = 0.0


class MotorCalibration(Group):
    """Calibration of one motor, as LeRobot writes it.

    Attributes:
        range_min: Lower end of the range of motion [counts].
        range_max: Upper end of the range of motion [counts].
        drive_mode: 1 for a motor whose direction is reversed.
        homing_offset: Offset of the position [counts]; it is not used.
        id: Number of the motor on its bus; it is not used.
    """

    range_min: Number
    range_max: Number
    drive_mode: Literal[0, 1] = 0
    homing_offset: Number = 0.0
    id: int = 0

    @model_validator(mode="after")
    def _has_range(self) -> MotorCalibration:
        # An empty calibrated range of a motor is an error, because normalised positions are fractions of the range.
        if not self.range_min < self.range_max:
            raise ValueError("a range_max above range_min")
        return self


class JointLog(Group):
    """Columns of one joint.

    Attributes:
        name: Name of the joint in the log; default: its name in the URDF.
        columns: Names of the columns of the joint.
        units: Units of the columns of the joint.
        counts_per_turn: Encoder counts per revolution of the joint.
        counts_per_metre: Encoder counts per metre of the joint.
        sign: -1 if position, velocity and torque in the log have the opposite sense of the URDF's axis.
        offset: Joint position at the logged value 0 [rad, m].
        gain: Torque per logged unit, e.g. gear times motor constant; negative if current and velocity have opposite
            senses [Nm/A].
        torque_offset: Torque at the logged value 0 [Nm, N].
        period: Interval after which logged values wrap around, e.g. 65536 counts of a 16-bit register or 360 degrees;
            default: one turn for the positions of joints without limits.
        sign_bit: Value of the sign bit, if logged values are sign and magnitude: with 32768, 32768 + x means -x.
        delay: Delays of the logged values, for a joint that is logged later than the others.
    """

    name: str | None = None
    columns: JointColumns = JointColumns()
    units: JointUnits = JointUnits()
    counts_per_turn: Positive | None = None
    counts_per_metre: Positive | None = None
    sign: Literal[1, -1] = 1
    offset: Place = 0.0
    gain: Number | None = None
    torque_offset: Number = 0.0
    period: JointWords = JointWords()
    sign_bit: JointWords = JointWords()
    delay: JointDelays = JointDelays()

    @model_validator(mode="after")
    def _moves(self) -> JointLog:
        # A gain of zero is an error, because it would convert every logged torque to zero.
        if self.gain == 0.0:
            raise ValueError("a gain that is not 0")
        return self


# One default object is shared by all joints without settings. This is safe, because settings are immutable.
_DEFAULT = JointLog()


class LogMapping(Group):
    """Mapping of logged columns to t, q, qd, tau in SI units, or to t, q and commanded positions u.

    It does not apply to files that spelgen has written.

    Attributes:
        topic: Topic to read, for a ROS bag with joint states in several topics.
        columns: Names of the columns, one per quantity.
        units: Units of the columns, one per quantity.
        input: "position" for position servos: u is read instead of qd and tau.
        velocity: "differentiated" for logs without velocities.
        torque_delay: Delay of the logged torques relative to the positions; `spelgen logs` suggests a value [s].
        joints: Columns of single joints, by the joint's name in the URDF.
        accept: Codes of errors of `spelgen logs` to ignore.
        dropouts: "dropped" removes rows in which a signal falls to 0 or deviates from its neighbours for at most five
            samples, and rows that repeat the row before.
        sample_rate: Rate of evenly spaced rows, whose times are ignored [Hz].
        calibration: Calibration of the motors by their names in the log, the content of LeRobot's calibration file, for
            the unit "normalised".
    """

    topic: str | None = None
    columns: LogColumns = LogColumns()
    units: LogUnits = LogUnits()
    input: Literal["torque", "position"] = "torque"
    velocity: Literal["logged", "differentiated"] = "logged"
    torque_delay: Delay = 0.0
    joints: dict[str, JointLog] = Field(default={})
    accept: tuple[Accepted, ...] = ()
    dropouts: Literal["kept", "dropped"] = "kept"
    sample_rate: Positive | None = None
    calibration: dict[str, MotorCalibration] = Field(default={})

    @field_validator("calibration", mode="before")
    @classmethod
    def _is_by_motor(cls, content: object) -> object:
        # Older versions of LeRobot wrote calibrations as lists of all motors, and data in degrees. Such a calibration
        # is an error, because data in degrees need no calibration.
        motors = content.values() if isinstance(content, dict) else ()
        if not all(isinstance(x, dict | MotorCalibration) for x in motors):
            raise ValueError(
                "range_min and range_max of each motor; data of an older LeRobot is in degrees, 'units: {q: deg}'"
            )
        return content

    @property
    def quantities(self) -> tuple[str, ...]:
        """Names of the quantities that a log must contain, besides the time."""
        # Fits of position servos compare positions only, so that velocities are not needed.
        if self.input == "position":
            return ("q", "u")
        # With "velocity: differentiated", velocities are computed from the positions, so a log needs no column of them.
        if self.velocity == "differentiated":
            return ("q", "tau")
        return ("q", "qd", "tau")

    def signals(self, joints: Sequence[str]) -> list[tuple[str, str]]:
        """Return (quantity, joint) of each logged column of these joints, sorted by quantity: positions are first."""
        return list(product(self.quantities, joints))

    def joint(self, name: str) -> JointLog:
        """Return the settings of the columns of a joint (name in the URDF); defaults if the joint has no settings."""
        return self.joints.get(name, _DEFAULT)

    def log_name(self, joint: str) -> str:
        """Return the name that a joint has in the log. joint: name of the joint in the URDF."""
        return self.joint(joint).name or joint

    def column(self, quantity: str, joint: str) -> str:
        """Return the name of the column of a quantity ("q", "qd", "tau" or "u") of a joint."""
        name: str | None = getattr(self.joint(joint).columns, quantity)
        return name or self.pattern(quantity).replace("{joint}", self.log_name(joint))

    def pattern(self, quantity: str) -> str:
        """Return the name of the columns of a quantity for all joints, with the placeholder `{joint}`."""
        return str(getattr(self.columns, quantity))

    def of_trajectory(self, text: str) -> LogMapping:
        """Return the mapping for one recording of a file with several recordings.

        The placeholder `{trajectory}` in names of columns is replaced by `text`.
        """
        # A column name without `{trajectory}` is unchanged: its column belongs to all recordings.
        named = {key: name.replace("{trajectory}", text) for key, name in self.columns}
        of_joints = {
            joint: {
                key: name and name.replace("{trajectory}", text) for key, name in self.joint(joint).columns
            }
            for joint in self.joints
        }
        return self.model_copy(update={"columns": LogColumns(**named)}).with_joint_columns(of_joints)

    def with_joint_columns(self, columns: Mapping[str, Mapping[str, str | None]]) -> LogMapping:
        """Return the mapping with other names of columns.

        columns: {joint: {quantity: name of the column}}. If a name is None, the name for all joints is used (attribute
        `columns` of the mapping).
        """
        joints = dict(self.joints)
        for joint, names in columns.items():
            logged = self.joint(joint)
            joints[joint] = logged.model_copy(update={"columns": logged.columns.model_copy(update=names)})
        return self.model_copy(update={"joints": joints})

    def with_turns(self, joints: Sequence[str]) -> LogMapping:
        """Return the mapping with a period of one turn for positions of joints without limits: wraps are then removed.

        joints: names of these joints. A period that the mapping contains already is unchanged.
        """
        changed = dict(self.joints)
        for joint in joints:
            logged = self.joint(joint)
            # A period that the mapping contains is kept, because it may be longer than a turn: the range of a register
            # that counts several turns.
            unstated = [x for x in ("q", "u") if not self.word("period", x, joint)]
            turns = {x: 2 * pi / abs(self.scale(x, joint)) for x in unstated}
            period = logged.period.model_copy(update=turns)
            changed[joint] = logged.model_copy(update={"period": period})
        return self.model_copy(update={"joints": changed})

    def in_si(self) -> LogMapping:
        """Return the mapping for the same signals in a file with SI units and default names of columns.

        `input` and `accept` are unchanged. For joints whose logged positions wrap around after a period, the period of
        positions becomes one turn, 2 pi rad.
        """
        # A joint with a period of positions may turn without limits. Its positions in the file with SI units may still
        # wrap around, then after one turn (2 pi rad) and not after the period of the log. The returned mapping
        # therefore has a period of one turn for such joints.
        turning = [name for name in self.joints if self.word("period", "q", name)]
        return LogMapping(input=self.input, accept=self.accept).with_turns(turning)

    def word(self, key: Decoding, quantity: str, joint: str) -> float | None:
        """Return the period or the sign bit of logged values of a quantity of a joint; None if it is not set.

        The result is in the unit of the log. key: name of the setting; a period is the interval after which logged
        values wrap around, a sign bit is the value s, such as 32768, with which s + x means -x. quantity: "q", "qd",
        "tau" or "u".
        """
        size: float | None = getattr(getattr(self.joint(joint), key), quantity)
        return size

    def period(self, quantity: str, joint: str) -> float:
        """Return the period in SI units at which logged values of a quantity of a joint wrap; 0 if it is not set."""
        return abs(self.scale(quantity, joint)) * (self.word("period", quantity, joint) or 0.0)

    def _unit(self, quantity: str, joint: str) -> tuple[float, str | None]:
        """Return the unit of a logged quantity of a joint as (factor, unit): (0.01, "deg") for "0.01 deg".

        Without a unit in the mapping, the result is (1, None). quantity: "q", "qd", "tau" or "u".
        """
        text: str | None = getattr(self.joint(joint).units, quantity) or getattr(self.units, quantity)
        # The default unit of commanded positions is the unit of measured positions, because one controller logs both.
        if text is None and quantity == "u":
            return self._unit("q", joint)
        factor, _, unit = (text or "").rpartition(" ")
        return float(factor or 1), unit or None

    def unit(self, quantity: str, joint: str) -> str | None:
        """Return the unit of a logged quantity of a joint, "deg" for the setting "0.01 deg"; None if it is not set."""
        return self._unit(quantity, joint)[1]

    @property
    def time_scale(self) -> float:
        """Factor that converts logged times to seconds."""
        factor, _, unit = self.units.t.rpartition(" ")
        return float(factor or 1) * TIMES[unit]

    def scale(self, quantity: str, joint: str) -> float:
        """Return the factor, with sign, that converts logged values of a quantity of a joint to SI units."""
        logged, (multiple, unit) = self.joint(joint), self._unit(quantity, joint)
        factor = SCALES.get(unit or "", 1.0)
        if quantity == "tau" and logged.gain is not None:
            factor *= logged.gain
        # A normalised position of -100 is the lower end and 100 the upper end of the calibrated range, which is given
        # in counts. drive_mode 1 reverses the direction.
        elif unit == NORMALISED:
            motor = self.calibration[self.log_name(joint)]
            counts = (motor.range_max - motor.range_min) / 200
            # The servos that LeRobot calibrates have 4,096 counts per revolution.
            factor = (1 - 2 * motor.drive_mode) * counts * 2 * pi / (logged.counts_per_turn or 4096)
        elif unit in COUNTS:
            turn = logged.counts_per_turn
            factor = 2 * pi / turn if turn else 1.0 / (logged.counts_per_metre or 1.0)
        return logged.sign * factor * multiple

    def offset(self, quantity: str, joint: str) -> float:
        """Return the offset of a quantity of a joint in SI units, which is added after multiplication by `scale`."""
        logged = self.joint(joint)
        if quantity == "tau":
            return logged.torque_offset
        return logged.offset if quantity in ("q", "u") else 0.0

    def delay(self, quantity: str, joint: str) -> float:
        """Return the delay of the logged values of a quantity of a joint relative to the other signals [s]."""
        delay: float = self.joint(joint).delay.model_dump().get(quantity, 0.0)
        return delay + self.torque_delay * (quantity == "tau")

    def misfits(self, joints: Sequence[str], joint_types: Sequence[str] | None = None) -> list[SettingsError]:
        """Return the errors in the units of the mapping for these joints.

        An error is a unit that a joint type cannot have, or a unit whose conversion needs a key that is absent.
        joint_types: "revolute" or "prismatic" per joint; None if the types are unknown.
        """
        errors = []
        kinds: dict[str, str | None] = dict.fromkeys(joints)
        kinds.update(zip(joints, joint_types or (), strict=joint_types is not None))
        for joint, quantity in product(joints, self.quantities):
            unit = self.unit(quantity, joint)
            expected = self._missing(unit, self.log_name(joint), self.joint(joint), kinds[joint])
            if expected:
                where = f"logs: joint {joint!r}, {quantity}"
                errors.append(SettingsError(f"the unit {unit}", element=where, expected=expected))
        return errors

    def _missing(self, unit: str | None, joint: str, logged: JointLog, kind: str | None) -> str | None:
        # A motor current, or a fraction of a rated torque, cannot be converted to a torque without a gain.
        if unit in CURRENTS and logged.gain is None:
            return "a gain beside it"
        if unit == NORMALISED and joint not in self.calibration:
            return f"the content of LeRobot's calibration file as 'calibration', with {joint!r} in it"
        if unit in COUNTS:
            # If the joint type is unknown, counts per turn and counts per metre are both accepted.
            in_turns = logged.counts_per_turn if kind != "prismatic" else None
            in_metres = logged.counts_per_metre if kind != "revolute" else None
            if not (in_turns or in_metres):
                return f"{'counts_per_metre' if kind == 'prismatic' else 'counts_per_turn'} beside it"
        if unit in ONLY.get(kind or "", set()):
            return f"one of a {kind} joint"
        return None
