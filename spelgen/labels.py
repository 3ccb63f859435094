"""Names of joints, units, entries of M and predictors in charts, tables and sentences."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import groupby

# Names of predictors in results, charts and tables.
MODEL = "model"  # name of the trained model in tables and charts
CONSTANT_VELOCITY = "velocity stays constant"
URDF, URDF_WITH_DRIVES = "URDF", "URDF and drives"
LEAST_SQUARES = "least squares"
LEAST_SQUARES_WITH_MEMORY = "least squares with memory"
LINEAR_SERVOS, DELAYED_COMMAND = "linear servo", "delayed command"

LAST_PART = " (last part)"
"""Suffix of a trajectory's name for its last part, which is used for validation, while the first part is fitted."""


@dataclass(frozen=True)
class Units:
    """Units of the position, velocity, torque (or force) of a joint, and of its diagonal entry of M (inertia)."""

    position: str
    velocity: str
    torque: str
    inertia: str


UNITS = {"revolute": Units("rad", "rad/s", "Nm", "kg m²"), "prismatic": Units("m", "m/s", "N", "kg")}
"""Units per joint type."""


INERTIAL_PARAMETERS = ("m", "hx", "hy", "hz", "Ixx", "Ixy", "Ixz", "Iyy", "Iyz", "Izz")
"""Inertial parameters of a body: mass, first moment, and inertia tensor about the origin of the joint's frame."""
# A base parameter is a linear combination of inertial parameters. Its name is its first inertial parameter in this
# order. Iyy, hz and m are last, because a revolute joint always allows regrouping them into other parameters.
BASE_ORDER = ("Izz", "Ixx", "Ixy", "Ixz", "Iyz", "hx", "hy", "m", "Iyy", "hz")


def parameter_name(index: int) -> str:
    """Return the name of an inertial parameter, such as ``Izz2``: component zz of the second body.

    index: index in the vector of all inertial parameters, with ten parameters per body, from 0.
    """
    return f"{INERTIAL_PARAMETERS[index % 10]}{index // 10 + 1}"


def base_name(first: str, terms: int) -> str:
    """Return the name of a base parameter: the name of its first term, with the suffix R if it has several terms."""
    return first + "R" * (terms > 1)


@dataclass(frozen=True)
class NamedJoint:
    """The name of a joint and the units of its quantities, for charts and tables."""

    name: str
    units: Units

    def axis(self, quantity: str, label: str = "") -> str:
        """Return the label of a chart's axis with the joint's unit: ``label [rad]`` for the quantity ``position``.

        quantity: ``position``, ``velocity``, ``torque`` or ``inertia``; it is also the label if ``label`` is empty.
        """
        return f"{label or quantity} [{asdict(self.units)[quantity]}]"


def named_joints(names: Sequence[str], joint_types: Sequence[str]) -> list[NamedJoint]:
    """Return the joints of a chart or table, each with its name and the units of its joint type."""
    return [NamedJoint(name, UNITS[x]) for name, x in zip(names, joint_types, strict=True)]


def torque_units(names: Sequence[str], joint_types: Sequence[str]) -> dict[str, str]:
    """Return {joint: unit of its torque, Nm or N}."""
    return {name: UNITS[joint_type].torque for name, joint_type in zip(names, joint_types, strict=True)}


def torques_text(torques: Mapping[str, str], units: Mapping[str, str]) -> str:
    """Return torques of joints with units, such as "lift 14 N, elbow 0.2, wrist 0.1 Nm".

    torques: {joint: number or numbers}. units: {joint: Nm or N}.
    """
    groups = groupby(torques, key=units.__getitem__)
    return ", ".join(f"{', '.join(f'{x} {torques[x]}' for x in group)} {unit}" for unit, group in groups)


def joint_ranges(joints: tuple[int, ...]) -> str:
    """Return joint indices (from 0) as numbers (from 1) in ranges: ``2-4,6`` for (1, 2, 3, 5), ``2,3`` for (1, 2)."""
    texts = []
    # Joint index minus position in the list is constant over consecutive joints, which therefore form one group.
    for _, indices in groupby(range(len(joints)), key=lambda index: joints[index] - index):
        run = [str(joints[index] + 1) for index in indices]
        texts += [f"{run[0]}-{run[-1]}"] if len(run) > 2 else run
    return ",".join(texts)


def cell_text(kind: str, joints: tuple[int, ...]) -> str:
    """Return the text of an entry of M in tables: the joints on which it depends, "C" if constant, "0" if always zero.

    kind: "zero", "constant" or "varying".
    """
    return {"zero": "0", "constant": "C"}.get(kind, joint_ranges(joints))


def joints_in_ranges(joints: tuple[int, ...]) -> str:
    """Return joint indices (from 0) as text with ranges: ``joint 2`` for (1,), ``joints 2-4,6`` for (1, 2, 3, 5)."""
    return f"joint{'s' * (len(joints) > 1)} {joint_ranges(joints)}"


def entry_name(row: int, column: int) -> str:
    """Return the name of an entry of M: ``M21`` for row 1 and column 0; with a comma from ten on, ``M12,1``."""
    # Without a comma M111 could mean row 1 and column 11, or row 11 and column 1.
    comma = "," * (max(row, column) >= 9)
    return f"M{row + 1}{comma}{column + 1}"


def joints_in_words(joints: Sequence[int]) -> str:
    """Return joint indices (from 0) in words: ``joint 2`` for (1,), ``joints 2, 3 and 5`` for (1, 2, 4)."""
    return f"joint{'s' * (len(joints) > 1)} {listed([str(joint + 1) for joint in sorted(joints)])}"


def axes_in_words(joints: Sequence[int]) -> str:
    """Return the axes of joint indices (from 0) in words: ``the axes of joints 2 and 3`` for (1, 2)."""
    return f"the {'axes' if len(joints) > 1 else 'axis'} of {joints_in_words(joints)}"


def listed(names: Sequence[str]) -> str:
    """Return names as an enumeration: ``a``, or ``a, b and c``."""
    *preceding, last = names
    return f"{', '.join(preceding)} and {last}" if preceding else last


def counted(count: int, noun: str) -> str:
    """Return a count with the noun in singular or plural: ``1 joint`` or ``2 joints``, ``2 trajectories``."""
    plural = f"{noun[:-1]}ies" if noun.endswith("y") else f"{noun}s"
    return f"{count} {noun if count == 1 else plural}"


def share(fraction: float, reference: str = "") -> str:
    """Return a fraction of ``reference`` as text: ``5 %``, ``5 % of the motion``, ``13.6 times the motion``."""
    # A fraction above 1 of a reference is written as a factor, which is easier to understand than a percentage: 2.5
    # times the motion, not 250 %.
    if fraction > 1:
        return f"{fraction:.3g} times {reference}" if reference else f"{100 * fraction:.0f} %"
    # Percentages close to 100 % have four digits, so that 99.96 % is not rounded to 100 %.
    digits = 4 if 0.99 <= fraction < 1 else 3
    percent = f"{100 * fraction:.{digits}g} %"
    return f"{percent} of {reference}" if reference else percent


def printable(text: str, allowed: str = "") -> str:
    """Return text from a file with its control characters escaped, except for the characters in ``allowed``."""
    safe = (x if x.isprintable() or x in allowed else x.encode("unicode_escape").decode() for x in text)
    return "".join(safe)


def short_name(name: str) -> str:
    """Return a name from a file for a line of a table: shortened, without control characters."""
    # Line ends and tabs in a name would break the layout of the table.
    line = " ".join(printable(name).split())
    # A table of 80 characters has room for names of 36 characters.
    return f"{line[:33]}..." if len(line) > 36 else line or '""'


def thousandths(joint_types: Sequence[str]) -> str:
    """Return the unit of small distances: ``mrad`` for revolute joints, ``mm`` for prismatic, ``mrad, mm`` for both."""
    units = {"mm" if joint_type == "prismatic" else "mrad" for joint_type in joint_types}
    return ", ".join(sorted(units, reverse=True)) or "mrad, mm"


def observed(predictor: str) -> str:
    """Return the name of ``predictor`` with a momentum observer, whose disturbance is added to the predictions."""
    return f"{predictor} + observer"


def is_drawn(predictor: str) -> bool:
    """Return True if charts show ``predictor``. With a disturbance observer, charts show only the trained model."""
    return predictor == observed(MODEL) or not predictor.endswith(observed(""))
