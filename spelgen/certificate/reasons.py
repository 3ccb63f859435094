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
    slider = later if axes.slides[later] else earlier
    if axes.slides[later] != axes.slides[earlier] and axes.parallel(later, earlier):
        return f"joint {slider + 1} slides along {{axes}}, and what turns about an axis never moves along it"
    if axes.slides[later] and axes.slides[earlier] and axes.perpendicular(later, earlier):
        return f"joint {earlier + 1} slides at right angles to {{joints}}"
    return balance_reason(axes, structure, entry)


def constant_reason(axes: Axes, structure: Structure, entry: MassEntry) -> str | None:
    """Return the reason for a constant entry."""
    later, earlier = entry.row, entry.column
    if later == earlier:
        return _diagonal_reason(axes, structure, later)
    if axes.slides[later] and axes.slides[earlier] and axes.fixed_angle(later, earlier):
        return "the two slide at a fixed angle, and the mass that both move does not change"
    if axes.slides[later] and not axes.slides[earlier] and axes.keep_offset(later, earlier):
        return (
            f"the mass that joint {later + 1} carries keeps its distance from the plane through "
            f"{axes_in_words([earlier])} along its slide"
        )
    turn = not axes.slides[later] and not axes.slides[earlier]
    if turn and axes.same_twist(later, earlier) and _diagonal_reason(axes, structure, later):
        same = entry_name(later, later)
        if axes.opposed(later, earlier):
            same = f"-{same}"
        return f"{joints_in_words([earlier, later])} turn about one line, so it is {same}"
    return balance_reason(axes, structure, entry)


def _diagonal_reason(axes: Axes, structure: Structure, joint: int) -> str | None:
    # Joints before this one move its load as a rigid body: they do not change the inertia about its axis.
    behind = range(joint + 1, len(axes.slides))
    if axes.slides[joint]:
        return "for a sliding joint the entry is the mass that it carries"
    if not behind:
        return f"joint {joint + 1} is the last, so the inertia about its axis stays the same"
    if all(axes.commute(joint, later) for later in behind):
        return f"all joints after joint {joint + 1} turn about its axis or slide along it"
    if len(behind) == 1 and structure.assume == "inertials" and axes.symmetric:
        return f"what joint {joint + 2} carries is symmetric about its axis"
    return None


def balance_reason(axes: Axes, structure: Structure, entry: MassEntry) -> str | None:
    """Return the reason for an entry of a balanced last body: the entry is Izz times the cosine of the axes."""
    last, earlier = len(structure.joints) - 1, entry.column
    if structure.assume != "inertials" or not axes.balanced or entry.row != last:
        return None
    # Rotation about a principal axis through the centre of mass has angular momentum along this axis only.
    balanced = f"what joint {last + 1} carries is balanced about its axis"
    if axes.without_inertia:
        return f"{balanced} and has no moment of inertia about it"
    if axes.slides[earlier]:
        return f"{balanced}, so turning it shifts no mass"
    if axes.perpendicular(last, earlier):
        return f"{balanced}, which is always at right angles to {{axes}}"
    if axes.fixed_angle(last, earlier):
        return f"{balanced}, which keeps its angle to {{axes}}"
    return None


def equality_reason(axes: Axes, structure: Structure, entries: Sequence[tuple[int, int]]) -> str | None:
    """Return the reason for equal entries of a row: the joints of the columns move the load of the row equally."""
    # Entries of different rows belong to different loads: there is no simple reason.
    rows, columns = map(sorted, zip(*entries, strict=True))
    if rows[0] != rows[-1]:
        return None
    if all(axes.same_twist(columns[0], column) for column in columns[1:]):
        if axes.slides[columns[0]]:
            return f"{joints_in_words(columns)} slide along one direction"
        return f"{joints_in_words(columns)} turn about one line"
    last = len(structure.joints) - 1
    if entries[0][0] == last and structure.assume == "inertials" and axes.balanced:
        turn = not any(axes.slides[column] for column in columns)
        if turn and all(axes.parallel(columns[0], column) for column in columns[1:]):
            balanced = f"what joint {last + 1} carries is balanced about its axis"
            return f"{balanced}, and {joints_in_words(columns)} are parallel"
    return None


def idle_reason(axes: Axes, structure: Structure, joint: int) -> str | None:
    """Return the reason for M not to depend on ``joint``."""
    if joint == 0:
        return "it moves the whole arm as one piece"
    # M does not depend on the pose of the base: a joint that commutes with all joints before it acts as the first.
    nearer = list(range(joint))
    if all(axes.commute(joint, earlier) for earlier in nearer):
        return f"it does not move {axes_in_words(nearer)}, as if it moved the whole arm"
    if joint == len(axes.slides) - 1 and structure.assume == "inertials" and axes.symmetric:
        return "what it carries is symmetric about its axis"
    return None


def weightless_reason(axes: Axes, structure: Structure, joint: int) -> str | None:
    """Return the reason for V not to depend on ``joint``."""
    if axes.lifts_nothing(joint):
        if axes.slides[joint]:
            return "sliding level lifts nothing"
        return "turning about the vertical lifts nothing"
    last = joint == len(axes.slides) - 1
    if last and structure.assume == "inertials" and axes.centred:
        return "the centre of the mass that it carries lies on its axis"
    return None


def potential_reason(axes: Axes, structure: Structure) -> str | None:
    """Return the reason for V = 0."""
    if not any(axes.arm.gravity):
        return "so is gravity"
    if all(axes.lifts_nothing(joint) for joint in range(len(structure.joints))):
        return "every joint turns about gravity's direction or slides across it, which lifts nothing"
    return None
