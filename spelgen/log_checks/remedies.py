"""Messages about a hypothesis that fits a log better than its mapping, and the settings that implement it."""

from dataclasses import dataclass, replace

import numpy as np

from spelgen.arm.actuation import Drives
from spelgen.arm.arm import Chain
from spelgen.errors import Diagnostic, LogError
from spelgen.identification.geometry_search import HypothesisComparison, position_unit
from spelgen.identification.log_geometry import Hypothesis, HypothesisFit
from spelgen.identification.tuning import GEOMETRY
from spelgen.logs.joint_signals import joint_keys, plain_number, settings_line
from spelgen.settings.log_mapping import LogMapping

GEOMETRY_CODES = (
    "joint-order", "torque-order", "motion-order", "joint-sense", "torque-sense", "joint-zero", "joint-unit",
    "joint-delay", "torque-unit", "torque-scale", "gravity", "gravity-compensated",
)  # fmt: skip
RIGHT = "joints, zeros, units and gravity as the URDF and the settings state them"


def mapped_reading(arm: Chain, mapping: LogMapping, drives: Drives) -> Hypothesis:
    """Return the `Hypothesis` without changes: signs, scales and offsets of the joints as in the mapping.

    The torque scale includes the gear ratios of the drives if each motor drives one joint.
    """
    joints = arm.joint_names
    gears = np.diag(drives.inputs) if np.count_nonzero(drives.inputs) == len(joints) else np.ones(len(joints))
    torque_scale = np.array([mapping.scale("tau", joint) for joint in joints])
    return replace(
        Hypothesis.unchanged(arm),
        motion_scale=np.array([mapping.scale("q", joint) for joint in joints]),
        torque_scale=torque_scale * np.where(gears, gears, 1.0),
        offset=np.array([mapping.offset("q", joint) for joint in joints]),
    )


@dataclass(frozen=True, eq=False)
class Remedies:
    """Converter of hypotheses about a log to findings with the settings that correct the log.

    unchanged: hypothesis of the log with its current mapping. by_name: True if the log consists of messages that
    contain joint names, as in ROS bags, and not of columns.
    """

    unchanged: Hypothesis
    arm: Chain
    mapping: LogMapping
    by_name: bool

    def finding(self, comparison: HypothesisComparison) -> LogError | Diagnostic:
        """Return the finding about a log for which another hypothesis fits better.

        It is an error, or a warning if an error of the URDF or of the mounting may be the reason: a small zero offset,
        a small tilt, or a moderate factor on the torques.
        """
        best, codes = comparison.better[0], comparison.codes
        changes = [self._change(code, best.hypothesis) for code in codes]
        where = " and ".join(dict.fromkeys(self._place(joints) for joints, _ in changes))
        got = f"{' and '.join(text for _, text in changes)} ({_evidence(best, comparison.unchanged)})"
        lines = [self.lines(fit.hypothesis) for fit in comparison.better]
        do = f"write {'; or '.join(dict.fromkeys(lines))}"
        if self._is_minor(best.hypothesis):
            code = "torque-scale" if codes[0] == "torque-unit" else codes[0]
            return Diagnostic("warning", code, where, None, f"{got}; {do}")
        do += f"; {' '.join(f'--accept {code}' for code in codes)} if it is right"
        return LogError(got, element=where, expected=RIGHT, do=do)

    def lines(self, reading: Hypothesis) -> str:
        """Return a text with the settings that implement a hypothesis, and where to write them."""
        texts = []
        keys = {name: self._joint_keys(k, reading) for k, name in enumerate(self.arm.joint_names)}
        changed = {name: changes for name, changes in keys.items() if changes}
        of_log = joint_keys(changed, self.arm.joint_names) if changed else {}
        if _is_common(reading.torque_delay):
            of_log["torque_delay"] = plain_number(self.mapping.torque_delay + reading.torque_delay[0])
        if of_log:
            line = settings_line(of_log)
            texts.append(f"'{line}' under 'logs' in the robot's YAML")
        if reading.gravity != self.unchanged.gravity:
            gravity = settings_line({"gravity": list(map(plain_number, reading.gravity))})
            texts.append(f"'{gravity}' in the robot's YAML (then build the model again)")
        return " and ".join(texts)

    def _joint_keys(self, k: int, reading: Hypothesis) -> dict[str, object]:
        """Return the settings of joint k in the group `logs` that a hypothesis changes."""
        joints, mapping, unchanged = self.arm.joint_names, self.mapping, self.unchanged
        present = mapping.joint(joints[k])
        keys: dict[str, object] = {}
        columns: dict[str, str] = {}
        motion, torque = joints[reading.motion_source[k]], joints[reading.torque_source[k]]
        for quantity in mapping.quantities:
            source = torque if quantity == "tau" else motion
            if source != joints[k]:
                columns[quantity] = mapping.column(quantity, source)
        if self.by_name and motion == torque != joints[k]:
            keys["name"] = mapping.log_name(motion)
        elif columns:
            keys["columns"] = columns
        factor = float(reading.motion_scale[k] / unchanged.motion_scale[k])
        sign = 1 if factor > 0 else -1
        if sign < 0:
            keys["sign"] = -present.sign
        if abs(factor) != 1:
            unit = self._unit(k, reading)
            keys["units"] = {"q": unit, "qd": f"{unit}/s"}
        gain = float(reading.torque_scale[k] / unchanged.torque_scale[k]) * sign
        if gain != 1.0:
            keys["gain"] = plain_number((present.gain or 1.0) * gain)
            if present.torque_offset:
                keys["torque_offset"] = present.torque_offset * gain * sign
        if reading.offset[k] != unchanged.offset[k]:
            keys["offset"] = plain_number(reading.offset[k])
        delays = {"q": reading.motion_delay[k], "qd": reading.motion_delay[k], "tau": reading.torque_delay[k]}
        stated = present.delay.model_dump()
        late = {x: plain_number(stated[x] + delays[x]) for x in mapping.quantities if delays[x]}
        if late and not _is_common(reading.torque_delay):
            keys["delay"] = {**present.delay.model_dump(exclude_unset=True), **late}
        return keys

    def _change(self, code: str, reading: Hypothesis) -> tuple[np.ndarray, str]:
        """Return a mask (n,) of the joints that a change affects, and a text that describes the fault of the log.

        code: code of the change. reading: hypothesis that contains the change.
        """
        unchanged, order = self.unchanged, np.arange(len(reading.offset))
        motion = reading.motion_scale / unchanged.motion_scale
        torque = reading.torque_scale / unchanged.torque_scale
        shifts = np.where(motion < 0, 0.0, reading.offset - unchanged.offset)
        k = int(np.abs(shifts).argmax())
        shift = f"{np.rad2deg(shifts[k]):.3g} degrees"
        if self.arm.coordinates[k].joint_type == "prismatic":
            shift = f"{shifts[k]:.3g} m"
        sense = "positions, velocities and torques of the opposite sense"
        if not (torque[motion < 0] < 0).all():
            sense = "positions and velocities of the opposite sense, and torques of the right one"
        largest = torque[np.abs(np.log(np.abs(torque))).argmax()]
        is_reversed = largest < 0 and not {"torque-sense", "joint-sense"}.intersection(reading.codes)
        reversed_too = " and of the opposite sense" if is_reversed else ""
        units = dict.fromkeys(self._unit(int(j), reading) for j in order if abs(motion[j]) != 1)
        delay = np.where(reading.motion_delay, reading.motion_delay, reading.torque_delay)
        shown = 1e3 * float(delay[np.abs(delay).argmax()])
        late = "torques" if not reading.motion_delay.any() else "positions and velocities"
        if reading.motion_delay.any() and reading.torque_delay.any():
            late = "positions, velocities and torques"
        changes = {
            "joint-order": (reading.motion_source != order, "the columns of other joints"),
            "motion-order": (reading.motion_source != order, "the positions and velocities of other joints"),
            "torque-order": (reading.torque_source != order, "the torques of other joints"),
            "joint-sense": (motion < 0, sense),
            "torque-sense": ((torque < 0) & (motion > 0), "torques of the opposite sense"),
            "torque-unit": (
                np.abs(torque) != 1,
                f"torques of another unit{reversed_too}, {abs(1 / largest):.3g} times as large",
            ),
            "joint-unit": (np.abs(motion) != 1, f"positions in {' and '.join(units)}"),
            "joint-delay": (
                delay != 0,
                f"{late} logged {abs(shown):.3g} ms {'later' if shown > 0 else 'earlier'}",
            ),
            "joint-zero": (shifts != 0, f"positions with another zero, by {shift}"),
        }
        return changes.get(code) or (order >= 0, self._gravity_text(code, reading))

    def _unit(self, k: int, reading: Hypothesis) -> str:
        return position_unit(self.arm.coordinates[k].joint_type, float(reading.motion_scale[k]))

    def _place(self, joints: np.ndarray) -> str:
        """Return a text that names the joints in a mask (n,), for a finding."""
        if joints.all() and len(joints) > 1:
            return "all joints"
        return f"joint {', '.join(map(repr, np.array(self.arm.joint_names)[joints].tolist()))}"

    def _gravity_text(self, code: str, reading: Hypothesis) -> str:
        present, new = np.array(self.unchanged.gravity), np.array(reading.gravity)
        if code == "gravity-compensated":
            part = float(new @ present / (present @ present))
            return f"torques in which gravity is compensated: {part:.2g} times the URDF's gravity remains in all joints"
        cosine = float(new @ present / max(np.linalg.norm(new) * np.linalg.norm(present), 1e-9))
        angle = np.rad2deg(np.arccos(np.clip(cosine, -1, 1)))
        return f"torques of a gravity that is {angle:.3g} degrees from its direction in the settings"

    def _is_minor(self, best: Hypothesis) -> bool:
        """Return True if the change may be due to an error of the URDF or of the arm's mounting, not of the log."""
        if best.codes == ("torque-unit",):
            factors = best.torque_scale / self.unchanged.torque_scale
            # inertials of a URDF are never wrong by a factor of ten, or by a negative one
            return bool((factors > 0.1).all() and (factors < 10).all())
        if best.codes == ("joint-zero",):
            return bool(np.abs(best.offset - self.unchanged.offset).max() < GEOMETRY.serious_angle)
        present = np.array(self.unchanged.gravity)
        turned = float(np.linalg.norm(present - np.array(best.gravity)))
        return best.codes == ("gravity",) and turned < GEOMETRY.serious_angle * float(np.linalg.norm(present))


def _is_common(delay: np.ndarray) -> bool:
    """Return True if all joints have the same delay (n,), and it is not 0."""
    return bool(delay.any() and (delay == delay[0]).all())


def _evidence(best: HypothesisFit, unchanged: HypothesisFit) -> str:
    """Return a sentence that compares the squared torque residuals, averaged over joints, of two hypotheses."""
    if best.hypothesis.codes == ("torque-unit",):
        return "by the URDF's gravity"
    before, after = unchanged.errors.mean(), best.errors.mean()
    if after < 0.9 * before:
        return f"the squared torque error of least squares falls from {before:.2%} to {after:.2%} of the variance"
    return "the torque error of least squares remains the same, with plausible masses, rotor inertias and friction"
