"""Give the reason why an entry is zero, constant or equal to another, and why a joint does not matter: the geometry.

M couples joints a and b by the integral of v_a . v_b over the mass that both move, v being the velocity field
of a unit rate: that integral is what the reasons speak of. Each function gives None where it finds none.
``{joints}`` and ``{axes}`` in a reason stand for the other joints concerned, and for their axes.
"""

from __future__ import annotations

from collections.abc import Sequence

from spelgen.certificate.axes import Axes
from spelgen.labels import axes_told, entry_name, joints_told
from spelgen.structure.structure import MassEntry, Structure


def zero_reason(axes: Axes, structure: Structure, entry: MassEntry) -> str | None:
    """Return why ``entry`` is zero."""
    later, earlier = entry.row, entry.column
    slider = later if axes.slides[later] else earlier
    if axes.slides[later] != axes.slides[earlier] and axes.parallel(later, earlier):
        return f"joint {slider + 1} slides along {{axes}}, and what turns about an axis never moves along it"
    if axes.slides[later] and axes.slides[earlier] and axes.perpendicular(later, earlier):
        return f"joint {earlier + 1} slides at right angles to {{joints}}"
    return balance_reason(axes, structure, entry)


def constant_reason(axes: Axes, structure: Structure, entry: MassEntry) -> str | None:
    """Return why ``entry`` is constant."""
    later, earlier = entry.row, entry.column
    if later == earlier:
        return _diagonal_reason(axes, structure, later)
    if axes.slides[later] and axes.slides[earlier] and axes.fixed_angle(later, earlier):
        return "the two slide at a fixed angle, and the mass that both move does not change"
    if axes.slides[later] and not axes.slides[earlier] and axes.keep_offset(later, earlier):
        return (
            f"the mass that joint {later + 1} carries keeps its distance from the plane through "
            f"{axes_told([earlier])} along its slide"
        )
    turn = not axes.slides[later] and not axes.slides[earlier]
    if turn and axes.move_alike(later, earlier) and _diagonal_reason(axes, structure, later):
        same = entry_name(later, later)
        if axes.opposed(later, earlier):
            same = f"-{same}"
        return f"{joints_told([earlier, later])} turn about one line, so it is {same}"
    return balance_reason(axes, structure, entry)


def _diagonal_reason(axes: Axes, structure: Structure, joint: int) -> str | None:
    # joints before this one move all that it carries as one piece, which changes no inertia
    behind = range(joint + 1, len(axes.slides))
    if axes.slides[joint]:
        return "for a sliding joint the entry is the mass that it carries"
    if not behind:
        return f"joint {joint + 1} is the last, so the inertia about its axis stays the same"
    if all(axes.commute(joint, other) for other in behind):
        return f"all joints after joint {joint + 1} turn about its axis or slide along it"
    if len(behind) == 1 and structure.assume == "inertials" and axes.symmetric:
        return f"what joint {joint + 2} carries is symmetric about its axis"
    return None


def balance_reason(axes: Axes, structure: Structure, entry: MassEntry) -> str | None:
    """Return why an entry of a balanced last body is what it is: it is Izz times the cosine between the axes."""
    last, other = len(structure.joints) - 1, entry.column
    if structure.assume != "inertials" or not axes.balanced or entry.row != last:
        return None
    # its velocity field about its own axis is a pure spin: only axes along it feel that
    balanced = f"what joint {last + 1} carries is balanced about its axis"
    if axes.without_inertia:
        return f"{balanced} and has no moment of inertia about it"
    if axes.slides[other]:
        return f"{balanced}, so turning it shifts no mass"
    if axes.perpendicular(last, other):
        return f"{balanced}, which is always at right angles to {{axes}}"
    if axes.fixed_angle(last, other):
        return f"{balanced}, which keeps its angle to {{axes}}"
    return None


def equality_reason(axes: Axes, structure: Structure, entries: Sequence[tuple[int, int]]) -> str | None:
    """Return why entries of one row are equal: their columns' joints move alike what the row's joint carries."""
    # entries of different rows belong to different masses: no simple reason makes these equal
    rows, columns = map(sorted, zip(*entries, strict=True))
    if rows[0] != rows[-1]:
        return None
    if all(axes.move_alike(columns[0], column) for column in columns[1:]):
        if axes.slides[columns[0]]:
            return f"{joints_told(columns)} slide along one direction"
        return f"{joints_told(columns)} turn about one line"
    last = len(structure.joints) - 1
    if entries[0][0] == last and structure.assume == "inertials" and axes.balanced:
        turn = not any(axes.slides[column] for column in columns)
        if turn and all(axes.parallel(columns[0], column) for column in columns[1:]):
            balanced = f"what joint {last + 1} carries is balanced about its axis"
            return f"{balanced}, and {joints_told(columns)} are parallel"
    return None


def idle_reason(axes: Axes, structure: Structure, joint: int) -> str | None:
    """Return why M does not depend on ``joint``."""
    if joint == 0:
        return "it moves the whole arm as one piece"
    # M is the same from whatever the base: a joint that commutes with all before it may count as the first
    nearer = list(range(joint))
    if all(axes.commute(joint, other) for other in nearer):
        return f"it does not move {axes_told(nearer)}, as if it moved the whole arm"
    if joint == len(axes.slides) - 1 and structure.assume == "inertials" and axes.symmetric:
        return "what it carries is symmetric about its axis"
    return None


def weightless_reason(axes: Axes, structure: Structure, joint: int) -> str | None:
    """Return why V does not depend on ``joint``."""
    if axes.lifts_nothing(joint):
        if axes.slides[joint]:
            return "sliding level lifts nothing"
        return "turning about the vertical lifts nothing"
    last = joint == len(axes.slides) - 1
    if last and structure.assume == "inertials" and axes.centred:
        return "the centre of the mass that it carries lies on its axis"
    return None


def potential_reason(axes: Axes, structure: Structure) -> str | None:
    """Return why V is zero."""
    if not any(axes.arm.gravity):
        return "so is gravity"
    if all(axes.lifts_nothing(joint) for joint in range(len(structure.joints))):
        return "every joint turns about gravity's direction or slides across it, which lifts nothing"
    return None
