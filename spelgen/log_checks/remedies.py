"""Lines of the settings for a better reading of a log, and the finding in words."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import yaml

from spelgen.arm.actuation import Drives
from spelgen.arm.arm import Arm
from spelgen.errors import Diagnostic, LogError
from spelgen.identification.geometry_search import Comparison
from spelgen.identification.log_geometry import Columns, Fit, Hypothesis
from spelgen.identification.tuning import GEOMETRY
from spelgen.log_checks.tuning import TUNING
from spelgen.settings.log_mapping import LogMapping

GRAVITY = ("gravity", "gravity-compensated")
GEOMETRY_CODES = (
    "joint-order", "torque-order", "joint-sense", "torque-sense", "joint-zero", "torque-unit", "torque-scale", *GRAVITY
)  # fmt: skip
RIGHT = "joints, zeros, units and gravity as the URDF and the settings state them"


def mapped_columns(arm: Arm, mapping: LogMapping, drives: Drives) -> Columns:
    """Return scales and offsets of the columns of an arm, by its mapping and the gears of single joints."""
    joints = arm.joint_names
    gears = np.diag(drives.inputs) if np.count_nonzero(drives.inputs) == len(joints) else np.ones(len(joints))
    return Columns(
        np.array([mapping.scale("q", joint) for joint in joints]),
        np.array([mapping.scale("tau", joint) for joint in joints]) * np.where(gears != 0, gears, 1.0),
        np.array([mapping.offset("q", joint) for joint in joints]),
    )


def settings_lines(
    reading: Hypothesis, unchanged: Hypothesis, arm: Arm, mapping: LogMapping, by_name: bool
) -> str:
    """Return the lines to write so that the columns of a log are read so, and where they belong.

    by_name: messages of joints by their names, as bags have them, and no columns.
    """
    texts = []
    joints = {}
    for k, name in enumerate(arm.joint_names):
        keys = _joint_keys(k, reading, unchanged, arm.joint_names, mapping, by_name)
        if keys:
            joints[name] = keys
    if joints:
        texts.append(f"'joints: {_flow(joints)}' under 'logs' in the robot's YAML")
    if reading.gravity != unchanged.gravity:
        gravity = _flow({"gravity": list(map(_number, reading.gravity))})[1:-1]
        texts.append(f"'{gravity}' in the robot's YAML (then build the model again)")
    return " and ".join(texts)


def _joint_keys(
    k: int,
    reading: Hypothesis,
    unchanged: Hypothesis,
    joints: Sequence[str],
    mapping: LogMapping,
    by_name: bool,
) -> dict[str, object]:
    """Return the keys of joint k in a mapping that differ from its present ones."""
    present = mapping.joint(joints[k])
    keys: dict[str, object] = {}
    columns: dict[str, str] = {}
    motion, torque = joints[reading.motion_source[k]], joints[reading.torque_source[k]]
    for quantity in mapping.quantities:
        source = torque if quantity == "tau" else motion
        if source != joints[k]:
            columns[quantity] = mapping.column(quantity, source)
    if by_name and motion == torque != joints[k]:
        keys["name"] = mapping.log_name(motion)
    elif columns:
        keys["columns"] = columns
    sign = float(reading.motion_scale[k] / unchanged.motion_scale[k])
    if sign < 0:
        keys["sign"] = -present.sign
    gain = float(reading.torque_scale[k] / unchanged.torque_scale[k]) / sign
    if gain != 1.0:
        keys["gain"] = _number((present.gain or 1.0) * gain)
        if present.torque_offset:
            keys["torque_offset"] = present.torque_offset * gain * sign
    if reading.offset[k] != unchanged.offset[k]:
        keys["offset"] = _number(reading.offset[k])
    return keys


def _flow(value: object) -> str:
    """Return a value as YAML in one line."""
    text: str = yaml.safe_dump(value, default_flow_style=True, sort_keys=False, width=float("inf"))
    return text.strip()


def _number(value: float) -> float:
    """Return a number with five digits; an integer if it is one."""
    rounded = float(f"{value:.5g}")
    return int(rounded) if rounded.is_integer() else rounded


def described(reading: Hypothesis, unchanged: Hypothesis, arm: Arm) -> tuple[str, str]:
    """Return the joints that a reading changes, as an error names its place, and the content of the log instead."""
    senses = np.sign(reading.motion_scale / unchanged.motion_scale)
    factors = reading.torque_scale / unchanged.torque_scale
    angles = np.where(senses == 1, reading.offset - unchanged.offset, 0.0)
    order = np.arange(len(senses))
    moved, exchanged = reading.motion_source != order, reading.torque_source != order
    names = np.array(arm.joint_names)
    texts, places = [], []
    for code in reading.codes:
        if code in GRAVITY:
            places.append("all joints")
            texts.append(_gravity_text(code, reading, unchanged))
            continue
        joints, text = {
            "joint-order": (moved, "the columns of other joints"),
            "torque-order": (exchanged, "the torques of other joints"),
            "joint-sense": (senses < 0, _sense_text(factors[senses < 0])),
            "torque-sense": ((factors < 0) & (senses > 0), "torques of the opposite sense"),
            "torque-unit": (
                np.abs(factors) != 1,
                f"torques of another unit, {1 / _extreme(factors):.3g} times as large",
            ),
            "joint-zero": (angles != 0, f"positions with another zero, by {_angle_text(arm, angles)}"),
        }[code]
        place = ", ".join(map(repr, names[joints].tolist()))
        places.append("all joints" if joints.all() and len(names) > 1 else f"joint {place}")
        texts.append(text)
    return " and ".join(dict.fromkeys(places)), " and ".join(texts)


def _extreme(factors: np.ndarray) -> float:
    """Return the factor that is farthest from 1."""
    return float(factors[np.abs(np.log(np.abs(factors))).argmax()])


def _sense_text(factors: np.ndarray) -> str:
    if (factors < 0).all():
        return "positions, velocities and torques of the opposite sense"
    return "positions and velocities of the opposite sense, and torques of the right one"


def _angle_text(arm: Arm, offsets: np.ndarray) -> str:
    k = int(np.abs(offsets).argmax())
    if arm.coordinates[k].kind == "prismatic":
        return f"{offsets[k]:.3g} m"
    return f"{np.rad2deg(offsets[k]):.3g} degrees"


def _gravity_text(code: str, reading: Hypothesis, unchanged: Hypothesis) -> str:
    present, new = np.array(unchanged.gravity), np.array(reading.gravity)
    if code == "gravity-compensated":
        part = float(new @ present / (present @ present))
        text = f"torques in which gravity is compensated: {part:.2g} times the URDF's gravity is left"
        return text + " in all joints"
    cosine = float(new @ present / max(np.linalg.norm(new) * np.linalg.norm(present), 1e-9))
    angle = np.rad2deg(np.arccos(np.clip(cosine, -1, 1)))
    return f"torques of a gravity that is {angle:.3g} degrees from its direction in the settings"


def evidence(best: Fit, unchanged: Fit) -> str:
    """Return the error reduction of a reading: mean over joints of the squared error."""
    if best.hypothesis.codes == ("torque-unit",):
        return "by the URDF's gravity"
    before, after = unchanged.errors.mean(), best.errors.mean()
    if after < 0.9 * before:
        return f"the squared torque error of least squares falls from {before:.2%} to {after:.2%} of the variance"
    return "the torque error of least squares remains the same, with plausible masses, rotor inertias and friction"


def geometry_finding(
    comparison: Comparison, arm: Arm, mapping: LogMapping, *, by_name: bool
) -> LogError | Diagnostic:
    """Return the finding of a better reading: an error, or a warning about small angles and moderate factors."""
    best, unchanged = comparison.better[0], comparison.unchanged
    where, got = described(best.hypothesis, unchanged.hypothesis, arm)
    got = f"{got} ({evidence(best, unchanged)})"
    lines = [
        settings_lines(x.hypothesis, unchanged.hypothesis, arm, mapping, by_name) for x in comparison.better
    ]
    do = f"write {'; or '.join(dict.fromkeys(lines))}"
    codes = comparison.codes
    if _is_minor(best.hypothesis, unchanged.hypothesis):
        code = "torque-scale" if codes[0] == "torque-unit" else codes[0]
        return Diagnostic("warning", code, where, None, f"{got}; {do}")
    do += f"; {' '.join(f'--accept {code}' for code in codes)} if it is right"
    return LogError(got, element=where, expected=RIGHT, do=do)


def _is_minor(best: Hypothesis, unchanged: Hypothesis) -> bool:
    """Whether errors of a URDF or a mounting, and no error of a log, may be the reason."""
    if len(best.codes) != 1:
        return False
    if best.codes == ("torque-unit",):
        factor = np.abs(np.log(best.torque_scale / unchanged.torque_scale)).max()
        return bool(factor < np.log(TUNING.impossible_factor))
    if best.codes == ("joint-zero",):
        return bool(np.abs(best.offset - unchanged.offset).max() < GEOMETRY.serious_angle)
    present = np.array(unchanged.gravity)
    turned = float(np.linalg.norm(present - np.array(best.gravity)))
    return best.codes == ("gravity",) and turned < GEOMETRY.serious_angle * float(np.linalg.norm(present))
