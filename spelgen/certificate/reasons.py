"""Geometric reasons for zero, constant and equal entries of M, and for joints without effect on M or V.

The entry of joints a and b is the integral of v_a . v_b over the mass that both move, with v the velocity field of a
unit rate; the reasons are properties of this integral. Each function returns None if it knows no reason. ``{joints}``
and ``{axes}`` in a reason are placeholders for the other joints of the entries, and for their axes.
"""

from __future__ import annotations

from collections.abc import Sequence

from spelgen.certificate.axes import Axes
from spelgen.labels import axes_in_words, entry_name, joints_in_words
from spelgen.structure.structure import MassEntry, Structure


def zero_reason(axes: Axes, structure: Structure, entry: MassEntry) -> str | None:
    """Return the reason for a zero entry."""
    later, earlier = entry.row, entry.column
    slider = later if axes.prismatic[later] else earlier
    if axes.prismatic[later] != axes.prismatic[earlier] and axes.parallel(later, earlier):
        parallel = f"prismatic joint {slider + 1} is parallel to {{axes}}"
        return f"{parallel}, and a rotation has no velocity along its axis"
    if axes.prismatic[later] and axes.prismatic[earlier] and axes.perpendicular(later, earlier):
        return f"prismatic joint {earlier + 1} is orthogonal to prismatic {{joints}}"
    return balance_reason(axes, structure, entry)


def constant_reason(axes: Axes, structure: Structure, entry: MassEntry) -> str | None:
    """Return the reason for a constant entry."""
    later, earlier = entry.row, entry.column
    if later == earlier:
        return _diagonal_reason(axes, structure, later)
    if axes.prismatic[later] and axes.prismatic[earlier] and axes.fixed_angle(later, earlier):
        return "both joints are prismatic, and the angle between their axes is constant"
    if axes.prismatic[later] and not axes.prismatic[earlier] and axes.keep_offset(later, earlier):
        return (
            f"the load of joint {later + 1} keeps its distance from the plane that contains "
            f"{axes_in_words([earlier])} and is parallel to joint {later + 1}"
        )
    revolute = not axes.prismatic[later] and not axes.prismatic[earlier]
    if revolute and axes.same_twist(later, earlier) and _diagonal_reason(axes, structure, later):
        same = entry_name(later, later)
        if axes.opposed(later, earlier):
            same = f"-{same}"
        return f"{joints_in_words([earlier, later])} are coaxial, so it equals {same}"
    return balance_reason(axes, structure, entry)


def _diagonal_reason(axes: Axes, structure: Structure, joint: int) -> str | None:
    # Joints before this one move its load as a rigid body: they do not change the inertia about its axis.
    behind = range(joint + 1, len(axes.prismatic))
    if axes.prismatic[joint]:
        return "the diagonal entry of a prismatic joint is the mass that it carries"
    if not behind:
        return f"joint {joint + 1} is the last and carries one rigid body"
    if all(axes.commute(joint, later) for later in behind):
        return f"all joints after joint {joint + 1} are coaxial revolute or parallel prismatic joints"
    if len(behind) == 1 and structure.assume == "inertials" and axes.symmetric:
        return f"the inertia of the load of joint {joint + 2} is symmetric about its axis"
    return None


def balance_reason(axes: Axes, structure: Structure, entry: MassEntry) -> str | None:
    """Return the reason for an entry of a balanced last body: Izz times the cosine of the angle between the axes."""
    last, earlier = len(structure.joints) - 1, entry.column
    if structure.assume != "inertials" or not axes.balanced or entry.row != last:
        return None
    # Rotation about a principal axis through the centre of mass has angular momentum along this axis only.
    balanced = f"the load of joint {last + 1} is dynamically balanced"
    if axes.without_inertia:
        return f"{balanced}, and its inertia about the joint axis is zero"
    if axes.prismatic[earlier]:
        return f"{balanced}, so its rotation does not move its centre of mass"
    if axes.perpendicular(last, earlier):
        return f"{balanced} about its axis, which is orthogonal to {{axes}}"
    if axes.fixed_angle(last, earlier):
        return f"{balanced} about its axis, which has a constant angle to {{axes}}"
    return None


def equality_reason(axes: Axes, structure: Structure, entries: Sequence[tuple[int, int]]) -> str | None:
    """Return the reason for equal entries of a row: the joints of the columns move the load of the row equally."""
    # Entries of different rows belong to different loads: there is no simple reason.
    rows, columns = map(sorted, zip(*entries, strict=True))
    if rows[0] != rows[-1]:
        return None
    if all(axes.same_twist(columns[0], column) for column in columns[1:]):
        if axes.prismatic[columns[0]]:
            return f"prismatic {joints_in_words(columns)} are parallel"
        return f"{joints_in_words(columns)} are coaxial"
    last = len(structure.joints) - 1
    if entries[0][0] == last and structure.assume == "inertials" and axes.balanced:
        revolute = not any(axes.prismatic[column] for column in columns)
        if revolute and all(axes.parallel(columns[0], column) for column in columns[1:]):
            balanced = f"the load of joint {last + 1} is dynamically balanced"
            return f"{balanced}, and {joints_in_words(columns)} are parallel"
    return None


def idle_reason(axes: Axes, structure: Structure, joint: int) -> str | None:
    """Return the reason for M not to depend on ``joint``."""
    if joint == 0:
        return "it moves the whole arm as one rigid body"
    # M does not depend on the pose of the base: a joint that commutes with all joints before it acts as the first.
    nearer = list(range(joint))
    if all(axes.commute(joint, earlier) for earlier in nearer):
        return f"its motion commutes with {joints_in_words(nearer)}, as if it were the first joint"
    if joint == len(axes.prismatic) - 1 and structure.assume == "inertials" and axes.symmetric:
        return "the inertia of its load is symmetric about its axis"
    return None


def weightless_reason(axes: Axes, structure: Structure, joint: int) -> str | None:
    """Return the reason for V not to depend on ``joint``."""
    if axes.is_weightless(joint):
        if axes.prismatic[joint]:
            return "gravity does no work in a translation orthogonal to it"
        return "gravity does no work in a rotation about an axis parallel to it"
    last = joint == len(axes.prismatic) - 1
    if last and structure.assume == "inertials" and axes.centred:
        return "the centre of mass of its load is on its axis"
    return None


def potential_reason(axes: Axes, structure: Structure) -> str | None:
    """Return the reason for V = 0."""
    if not any(axes.arm.gravity):
        return "gravity is zero"
    if all(axes.is_weightless(joint) for joint in range(len(structure.joints))):
        return "every axis is parallel to gravity if revolute, orthogonal to it if prismatic"
    return None
