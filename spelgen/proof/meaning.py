"""Structure -> plain words: which entries are zero, constant or equal, which joints do not matter, and why.

A reason is given only where the arm's exact geometry proves it. M couples joints a and b by the integral of
v_a . v_b over the mass that both move, v being the velocity field of a unit rate: that integral is what the
reasons speak of.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from fractions import Fraction

from spelgen.arm.arm import Arm
from spelgen.arm.rational import ZERO
from spelgen.proof.axes import Axes, is_plain
from spelgen.structure.basis import Constant, Output
from spelgen.structure.structure import Entry, Structure

_UNKNOWN = {
    "kinematics": "no simple geometric reason; it follows from the exact ranks",
    "inertials": "no simple geometric reason; it holds for the URDF's inertial values",
}


@dataclass(frozen=True)
class Fact:
    """Something that always holds, and why."""

    statement: str
    reason: str

    def to_dict(self) -> dict[str, str]:
        """The two fields as a JSON object."""
        return asdict(self)

    def __str__(self) -> str:
        return f"{self.statement}: {self.reason}"


def entry_name(row: int, column: int) -> str:
    """How an entry of M is called, from its 0-based place: M21, or M12,1 from ten joints on."""
    separator = "," if max(row, column) >= 9 else ""
    return f"M{row + 1}{separator}{column + 1}"


def facts(arm: Arm, structure: Structure) -> tuple[Fact, ...]:
    """What holds of M and V at all configurations, with the reason where geometry gives a simple one."""
    axes = Axes(arm) if is_plain(arm) else None
    unknown = _UNKNOWN[structure.assume]
    if axes is None:
        unknown = "bodies share a coordinate, so no simple geometric reason is sought; the exact ranks tell"
    return tuple(
        Fact(statement, reason or unknown)
        for statement, reason in (
            *_zeros(axes, structure),
            *_constants(axes, structure),
            *_equalities(axes, structure),
            *_idle_joints(axes, structure),
            *_potential(axes, structure),
        )
    )


def _zeros(axes: Axes | None, structure: Structure) -> Iterator[tuple[str, str]]:
    """Zeros along an axis by the joint that slides, right angles by a joint many have, then the others."""
    along: dict[int, list[Entry]] = {}
    across, left = [], []
    for entry in structure.entries:
        a, b = entry.row, entry.column
        if entry.kind != "zero":
            continue
        if axes is not None and axes.slides[a] != axes.slides[b] and axes.parallel(a, b):
            along.setdefault(a if axes.slides[a] else b, []).append(entry)
        elif axes is not None and axes.slides[a] and axes.slides[b] and axes.perpendicular(a, b):
            across.append(entry)
        else:
            left.append(entry)
    for slider, group in sorted(along.items()):
        others = _others(group, slider)
        which = f"joint {slider + 1} slides along the {_noun('axis', 'axes', others)} of {_joints(others)}"
        yield _are(group, "always zero"), f"{which}, and what turns about an axis never moves along it"
    while across:
        places = [joint for entry in across for joint in (entry.row, entry.column)]
        most = max(sorted(set(places)), key=places.count)
        group = [entry for entry in across if most in (entry.row, entry.column)]
        across = [entry for entry in across if entry not in group]
        reason = f"joint {most + 1} slides at right angles to {_joints(_others(group, most))}"
        yield _are(group, "always zero"), reason
    yield from _by_reason(left, "always zero", lambda entry: _balance_reason(axes, structure, entry))


def _constants(axes: Axes | None, structure: Structure) -> Iterator[tuple[str, str]]:
    entries = [entry for entry in structure.entries if entry.kind == "constant"]
    yield from _by_reason(entries, "constant", lambda entry: _constant_reason(axes, structure, entry))


def _by_reason(
    entries: Sequence[Entry], what: str, reason: Callable[[Entry], str]
) -> Iterator[tuple[str, str]]:
    """The entries grouped by their reasons, those without one last."""
    groups: dict[str, list[Entry]] = {}
    for entry in entries:
        groups.setdefault(reason(entry), []).append(entry)
    for told, group in sorted(groups.items(), key=lambda item: not item[0]):
        yield _are(group, what), told


def _constant_reason(axes: Axes | None, structure: Structure, entry: Entry) -> str:
    if axes is None:
        return ""
    later, earlier = entry.row, entry.column
    if later == earlier:
        return _diagonal_reason(axes, structure, later)
    if axes.slides[later] and axes.slides[earlier] and axes.fixed_angle(later, earlier):
        return "the two slide at a fixed angle, and the mass that both move does not change"
    if axes.slides[later] and not axes.slides[earlier] and axes.keep_offset(later, earlier):
        return (
            f"the mass that joint {later + 1} carries keeps its distance from the plane spanned by its slide "
            f"and the axis of joint {earlier + 1}"
        )
    turn = not axes.slides[later] and not axes.slides[earlier]
    if turn and axes.same_line(later, earlier) and _diagonal_reason(axes, structure, later):
        return (
            f"joints {earlier + 1} and {later + 1} turn about one line, so it is {entry_name(later, later)}"
        )
    return _balance_reason(axes, structure, entry)


def _diagonal_reason(axes: Axes, structure: Structure, joint: int) -> str:
    behind = range(joint + 1, len(axes.slides))
    if axes.slides[joint]:
        return "for a sliding joint the entry is the mass that it carries"
    if not behind:
        return f"joint {joint + 1} is the last, so the inertia about its axis stays the same"
    if all(axes.commute(joint, other) for other in behind):
        return f"all joints after joint {joint + 1} turn about its axis or slide along it"
    if len(behind) == 1 and structure.assume == "inertials" and axes.symmetric:
        return f"what joint {joint + 2} carries is symmetric about its axis"
    return ""


def _balance_reason(axes: Axes | None, structure: Structure, entry: Entry) -> str:
    """Why an entry of a balanced last body is what it is: it is Izz times the cosine between the axes."""
    last, other = len(structure.joints) - 1, entry.column
    if axes is None or structure.assume != "inertials" or not axes.balanced or entry.row != last:
        return ""
    balanced = f"what joint {last + 1} carries is balanced about its axis"
    if axes.without_inertia:
        return f"{balanced}, with no moment of inertia"
    if axes.slides[other]:
        return f"{balanced}, so turning it shifts no mass"
    if axes.perpendicular(last, other):
        return f"{balanced}, which is always at right angles to the other joint's"
    if axes.fixed_angle(last, other):
        return f"{balanced}, which keeps its angle to the other joint's"
    return ""


def _equalities(axes: Axes | None, structure: Structure) -> Iterator[tuple[str, str]]:
    """Entries that are equal, or opposite, at every configuration: the smallest form writes them alike."""
    terms: tuple[Output | Constant, ...] = (*structure.outputs, *structure.constants)
    shares: dict[tuple[int, int], dict[int, Fraction]] = {}
    for number, term in enumerate(terms):
        for row, column, factor in term.basis:
            shares.setdefault((row, column), {})[number] = factor
    groups: dict[tuple[tuple[int, Fraction], ...], list[tuple[Fraction, tuple[int, int]]]] = {}
    for place, share in sorted(shares.items()):
        sign = Fraction(1 if share[min(share)] > 0 else -1)
        groups.setdefault(tuple(sorted((k, sign * x) for k, x in share.items())), []).append((sign, place))
    for group in groups.values():
        if len(group) > 1:
            first = group[0][0]
            names = [("" if sign == first else "-") + entry_name(*place) for sign, place in group]
            reason = "" if axes is None else _equality_reason(axes, structure, [place for _, place in group])
            yield f"{' = '.join(names)} always", reason


def _equality_reason(axes: Axes, structure: Structure, places: Sequence[tuple[int, int]]) -> str:
    """Why entries of one row are equal: their columns' joints move alike what the row's joint carries."""
    columns = sorted(column for _, column in places)
    if len({row for row, _ in places}) > 1:
        return ""
    slides = axes.slides[columns[0]]
    if all(axes.move_alike(columns[0], column) for column in columns[1:]):
        return f"{_joints(columns)} {'slide along one direction' if slides else 'turn about one line'}"
    last = len(structure.joints) - 1
    if places[0][0] == last and structure.assume == "inertials" and axes.balanced:
        turn = not any(axes.slides[column] for column in columns)
        if turn and all(axes.parallel(columns[0], column) for column in columns[1:]):
            balanced = f"what joint {last + 1} carries is balanced about its axis"
            return f"{balanced}, and {_joints(columns)} are parallel"
    return ""


def _idle_joints(axes: Axes | None, structure: Structure) -> Iterator[tuple[str, str]]:
    """Joints that no entry of M depends on."""
    matter = {joint for entry in structure.entries for joint in entry.joints}
    if matter:  # else every entry is zero or constant, which has been told
        for joint in range(len(structure.joints)):
            if joint not in matter:
                reason = "" if axes is None else _idle_reason(axes, structure, joint)
                yield f"M does not depend on joint {joint + 1}", reason


def _idle_reason(axes: Axes, structure: Structure, joint: int) -> str:
    if joint == 0:
        return "it moves the whole arm as one piece"
    before = list(range(joint))
    if all(axes.commute(joint, other) for other in before):
        noun = _noun("axis", "axes", before)
        return f"it leaves the {noun} of {_joints(before)} in place, as if it moved the whole arm"
    if joint == len(axes.slides) - 1 and structure.assume == "inertials" and axes.symmetric:
        return "what it carries is symmetric about its axis"
    return ""


def _potential(axes: Axes | None, structure: Structure) -> Iterator[tuple[str, str]]:
    joints = range(len(structure.joints))
    if not structure.potential:
        reason = ""
        if axes is not None and axes.arm.gravity == ZERO:
            reason = "so is gravity"
        elif axes is not None and all(axes.lifts_nothing(joint) for joint in joints):
            reason = "every joint turns about gravity's direction or slides across it: nothing is lifted"
        yield "V is zero", reason
        return
    groups: dict[str, list[int]] = {}
    for joint in joints:
        if joint not in structure.potential:
            reason = "" if axes is None else _weightless_reason(axes, structure, joint)
            groups.setdefault(reason, []).append(joint)
    for reason, group in groups.items():
        yield f"V does not depend on {_joints(group)}", reason


def _weightless_reason(axes: Axes, structure: Structure, joint: int) -> str:
    if axes.lifts_nothing(joint):
        return (
            "sliding level lifts nothing"
            if axes.slides[joint]
            else "turning about the vertical lifts nothing"
        )
    last = joint == len(axes.slides) - 1
    if last and structure.assume == "inertials" and axes.centred:
        return "the centre of the mass that it carries lies on its axis"
    return ""


def _others(entries: Sequence[Entry], joint: int) -> list[int]:
    return sorted({each for entry in entries for each in (entry.row, entry.column)} - {joint})


def _are(entries: Sequence[Entry], what: str) -> str:
    names = [entry_name(entry.row, entry.column) for entry in entries]
    return f"{_listed(names)} {'is' if len(names) == 1 else 'are'} {what}"


def _joints(joints: Sequence[int]) -> str:
    return f"joint{'s' * (len(joints) > 1)} {_listed([str(joint + 1) for joint in sorted(joints)])}"


def _noun(one: str, many: str, joints: Sequence[int]) -> str:
    return one if len(joints) == 1 else many


def _listed(parts: Sequence[str]) -> str:
    return parts[0] if len(parts) == 1 else f"{', '.join(parts[:-1])} and {parts[-1]}"
