"""Structure -> plain words: which entries are zero, constant or equal, which joints do not matter, and why.

A reason is given only where the arm's exact geometry proves it (``reasons``).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from fractions import Fraction

from spelgen.arm.arm import Arm
from spelgen.certificate import reasons
from spelgen.certificate.axes import Axes, is_plain
from spelgen.labels import axes_told, entry_name, joints_told, listed
from spelgen.structure.basis import Constant, Output
from spelgen.structure.structure import Entry, Structure

Reason = str | None


@dataclass(frozen=True)
class Fact:
    """Something that always holds, what it means for the model, and why it holds.

    ``reason`` is None where geometry gives no simple one, and where bodies share a coordinate: there the
    exact ranks tell the fact and nothing more.
    """

    statement: str
    means: str
    reason: Reason

    def to_dict(self) -> dict[str, Reason]:
        """The three fields as a JSON object."""
        return asdict(self)

    def __str__(self) -> str:
        because = f": {self.reason}" if self.reason else ""
        return f"{self.statement}{because}. {self.means}."


def facts(arm: Arm, structure: Structure) -> tuple[Fact, ...]:
    """What holds of M and V at all configurations, with the reason where geometry gives a simple one."""
    axes = Axes(arm) if is_plain(arm) else None
    return (
        *_zeros(axes, structure),
        *_constants(axes, structure),
        *_equalities(axes, structure),
        *_idle_joints(axes, structure),
        *_potential(axes, structure),
    )


def _zeros(axes: Axes | None, structure: Structure) -> Iterator[Fact]:
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
        which = f"joint {slider + 1} slides along {axes_told(_others(group, slider))}"
        yield _zero(group, f"{which}, and what turns about an axis never moves along it")
    while across:
        places = [joint for entry in across for joint in (entry.row, entry.column)]
        most = max(sorted(set(places)), key=places.count)
        group = [entry for entry in across if most in (entry.row, entry.column)]
        across = [entry for entry in across if entry not in group]
        yield _zero(group, f"joint {most + 1} slides at right angles to {joints_told(_others(group, most))}")
    for reason, group in _by_reason(axes, structure, left, reasons.balance_reason):
        yield _zero(group, reason)


def _zero(group: Sequence[Entry], reason: Reason) -> Fact:
    return Fact(f"{_are(group)} always zero", f"Nothing is learned for {_it(group)}", reason)


def _constants(axes: Axes | None, structure: Structure) -> Iterator[Fact]:
    entries = [entry for entry in structure.entries if entry.kind == "constant"]
    for reason, group in _by_reason(axes, structure, entries, reasons.constant_reason):
        means = "It needs a number" if len(group) == 1 else "They need numbers"
        yield Fact(f"{_are(group)} constant", f"{means}, no network", reason)


def _by_reason(
    axes: Axes | None,
    structure: Structure,
    entries: Sequence[Entry],
    why: Callable[[Axes, Structure, Entry], Reason],
) -> Iterator[tuple[Reason, list[Entry]]]:
    """The entries grouped by their reasons, those without one last."""
    groups: dict[Reason, list[Entry]] = {}
    for entry in entries:
        groups.setdefault(None if axes is None else why(axes, structure, entry), []).append(entry)
    for reason, group in sorted(groups.items(), key=lambda item: item[0] is None):
        axes_of_columns = axes_told(sorted({entry.column for entry in group}))
        yield reason and reason.format(axes=axes_of_columns), group


def _equalities(axes: Axes | None, structure: Structure) -> Iterator[Fact]:
    """Entries that are equal, or opposite, at every configuration: the smallest form writes them alike."""
    terms: tuple[Output | Constant, ...] = (*structure.outputs, *structure.constants)
    factors: dict[tuple[int, int], dict[int, Fraction]] = {}
    for number, term in enumerate(terms):
        for row, column, factor in term.basis:
            factors.setdefault((row, column), {})[number] = factor
    groups: dict[tuple[tuple[int, Fraction], ...], list[tuple[Fraction, tuple[int, int]]]] = {}
    for place, of_entry in sorted(factors.items()):
        sign = Fraction(1 if of_entry[min(of_entry)] > 0 else -1)
        groups.setdefault(tuple(sorted((k, sign * x) for k, x in of_entry.items())), []).append((sign, place))
    for group in groups.values():
        if len(group) > 1:
            first = group[0][0]
            names = [("" if sign == first else "-") + entry_name(*place) for sign, place in group]
            places = [place for _, place in group]
            reason = None if axes is None else reasons.equality_reason(axes, structure, places)
            yield Fact(f"{' = '.join(names)} always", "One of them is learned", reason)


def _idle_joints(axes: Axes | None, structure: Structure) -> Iterator[Fact]:
    """Joints that no entry of M depends on."""
    matter = {joint for entry in structure.entries for joint in entry.joints}
    if matter:  # else every entry is zero or constant, which has been told
        for joint in range(len(structure.joints)):
            if joint not in matter:
                reason = None if axes is None else reasons.idle_reason(axes, structure, joint)
                yield Fact(f"M does not depend on joint {joint + 1}", "No network of M reads it", reason)


def _potential(axes: Axes | None, structure: Structure) -> Iterator[Fact]:
    if not structure.potential:
        reason = None if axes is None else reasons.potential_reason(axes)
        yield Fact("V is zero", "It needs no network", reason)
        return
    groups: dict[Reason, list[int]] = {}
    for joint in range(len(structure.joints)):
        if joint not in structure.potential:
            reason = None if axes is None else reasons.weightless_reason(axes, structure, joint)
            groups.setdefault(reason, []).append(joint)
    for reason, group in groups.items():
        means = f"The network of V does not read {'it' if len(group) == 1 else 'them'}"
        yield Fact(f"V does not depend on {joints_told(group)}", means, reason)


def _others(entries: Sequence[Entry], joint: int) -> list[int]:
    return sorted({each for entry in entries for each in (entry.row, entry.column)} - {joint})


def _are(entries: Sequence[Entry]) -> str:
    names = [entry_name(entry.row, entry.column) for entry in entries]
    return f"{listed(names)} {'is' if len(names) == 1 else 'are'}"


def _it(entries: Sequence[Entry]) -> str:
    return "it" if len(entries) == 1 else "them"
