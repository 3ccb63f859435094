"""Names of joints, units and entries of M in charts, tables and sentences."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass

MAX_NAME = 36


@dataclass(frozen=True)
class Units:
    """Units of the quantities of a joint. torque: of its torque or force. inertia: of the diagonal entry of M."""

    position: str
    velocity: str
    torque: str
    inertia: str


UNITS = {"revolute": Units("rad", "rad/s", "Nm", "kg m²"), "prismatic": Units("m", "m/s", "N", "kg")}
"""Units per joint type."""


INERTIAL_PARAMETERS = ("m", "hx", "hy", "hz", "Ixx", "Ixy", "Ixz", "Iyy", "Iyz", "Izz")
"""Ten per body: mass, first moment, tensor about the origin of the joint's frame."""
# The first parameter of a group of regrouped parameters names the group. Iyy, hz and m come last, because those
# parameters of a body with a revolute joint can always be regrouped into others.
BASE_ORDER = ("Izz", "Ixx", "Ixy", "Ixz", "Iyz", "hx", "hy", "m", "Iyy", "hz")


def parameter_name(index: int) -> str:
    """Return the name of an inertial parameter: ``Izz2`` is the tensor component zz of the second body."""
    return f"{INERTIAL_PARAMETERS[index % 10]}{index // 10 + 1}"


@dataclass(frozen=True)
class NamedJoint:
    """The name of a joint and its units."""

    name: str
    units: Units

    def axis(self, quantity: str, label: str = "") -> str:
        """Return ``label [rad]`` with the unit of ``position``, ``velocity`` or ``torque``."""
        return f"{label or quantity} [{asdict(self.units)[quantity]}]"


def named_joints(names: Sequence[str], joint_types: Sequence[str]) -> list[NamedJoint]:
    """Return the joints with the units of their types."""
    return [NamedJoint(name, UNITS[x]) for name, x in zip(names, joint_types, strict=True)]


def joint_ranges(joints: tuple[int, ...]) -> str:
    """Return the numbers of joints, from 1, with ranges of three or more: ``2-6`` or ``2,4``."""
    runs: list[list[int]] = []
    for joint in joints:
        if runs and joint == runs[-1][-1] + 1:
            runs[-1].append(joint)
        else:
            runs.append([joint])
    texts = []
    for run in runs:
        if len(run) > 2:
            texts.append(f"{run[0] + 1}-{run[-1] + 1}")
        else:
            texts += [str(joint + 1) for joint in run]
    return ",".join(texts)


def joints_in_ranges(joints: tuple[int, ...]) -> str:
    """Return ``joint 2``, or ``joints 2-4,6``."""
    return f"{_plural('joint', joints)} {joint_ranges(joints)}"


def entry_name(row: int, column: int) -> str:
    """Return the name of an entry of M with indices from 0: M21, or M12,1 from the tenth joint."""
    if max(row, column) >= 9:
        return f"M{row + 1},{column + 1}"
    return f"M{row + 1}{column + 1}"


def joints_in_words(joints: Sequence[int]) -> str:
    """Return ``joint 2``, or ``joints 2, 3 and 5``."""
    return f"{_plural('joint', joints)} {listed([str(joint + 1) for joint in sorted(joints)])}"


def axes_in_words(joints: Sequence[int]) -> str:
    """Return ``the axis of joint 2``, or ``the axes of joints 2 and 3``."""
    if len(joints) == 1:
        return f"the axis of {joints_in_words(joints)}"
    return f"the axes of {joints_in_words(joints)}"


def listed(names: Sequence[str]) -> str:
    """Return ``a``, or ``a, b and c``."""
    *preceding, last = names
    if not preceding:
        return last
    return f"{', '.join(preceding)} and {last}"


def counted(count: int, noun: str) -> str:
    """Return ``1 joint`` or ``2 joints``, ``1 trajectory`` or ``2 trajectories``."""
    if count == 1:
        return f"1 {noun}"
    if noun.endswith("y"):
        return f"{count} {noun[:-1]}ies"
    return f"{count} {noun}s"


def share(fraction: float, reference: str = "") -> str:
    """Return ``5 % of the motion``, or ``13.6 times the motion`` for a fraction above 1."""
    if fraction > 1:
        return f"{fraction:.3g} times {reference}".rstrip()
    # four digits close to 100 %
    digits = 4 if 0.99 <= fraction < 1 else 3
    percent = f"{100 * fraction:.{digits}g} %"
    return f"{percent} of {reference}" if reference else percent


def printable(text: str, allowed: str = "") -> str:
    """Return text from a file with escaped control characters, except the characters ``allowed``."""
    characters = []
    for character in text:
        if not character.isprintable() and character not in allowed:
            character = character.encode("unicode_escape").decode()
        characters.append(character)
    return "".join(characters)


def short_name(name: str) -> str:
    """Return a name from a file for a line of a table: shortened, without control characters."""
    line = " ".join(printable(name).split())
    if len(line) > MAX_NAME:
        return f"{line[: MAX_NAME - 3]}..."
    return line or '""'


def thousandths(joint_types: Sequence[str]) -> str:
    """Return the unit of small distances of these joints: ``mrad``, ``mm`` or, for both types, ``mrad, mm``."""
    kinds = {kind == "prismatic" for kind in joint_types}
    if kinds == {True}:
        return "mm"
    if kinds == {False}:
        return "mrad"
    return "mrad, mm"


def _plural(noun: str, items: Sequence[int]) -> str:
    if len(items) > 1:
        return f"{noun}s"
    return noun
