"""A structure in words: zero, constant and equal entries of M, joints without effect on M or V, and the reasons.

A reason is given only if the exact geometry of the arm proves it (``reasons``).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from fractions import Fraction

from spelgen.arm.arm import Chain
from spelgen.certificate import reasons
from spelgen.certificate.axes import Axes, is_plain
from spelgen.labels import axes_in_words, entry_name, joints_in_words, listed
from spelgen.structure.structure import MassEntry, Structure

Reason = str | None
EntryReason = Callable[[Axes, Structure, MassEntry], Reason]


@dataclass(frozen=True)
class Fact:
    """A property of M or V at all configurations, its consequence for the model (``means``), and its reason.

    ``reason`` is None if the geometry gives no simple reason, or if bodies share a coordinate: the fact then follows
    from exact ranks only.
    """

    statement: str
    means: str
    reason: Reason

    def __str__(self) -> str:
        if self.reason:
            return f"{self.statement}: {self.reason}. {self.means}."
        return f"{self.statement}. {self.means}."


def facts(arm: Chain, structure: Structure) -> tuple[Fact, ...]:
    """Return the properties of M and V at all configurations, with simple geometric reasons if there are any."""
    # A mimic joint moves several bodies, for which the reasons about pairs of axes are not valid.
    axes = None
    if is_plain(arm):
        axes = Axes(arm)
    words = _Sentences(structure, axes)
    zero = ("always zero", "Nothing is learned for it", "Nothing is learned for them")
    constant = ("constant", "It needs one parameter and no network", "They need parameters and no networks")
    return (
        *words.entries("zero", reasons.zero_reason, *zero),
        *words.entries("constant", reasons.constant_reason, *constant),
        *words.equalities(),
        *words.idle_joints(),
        *words.potential(),
    )


@dataclass(frozen=True)
class _Sentences:
    """The facts of a structure. axes: None if bodies share coordinates, and no reasons are given."""

    structure: Structure
    axes: Axes | None

    def _reason(self, why: Callable[..., Reason], *subject: object) -> Reason:
        if self.axes is None:
            return None
        return why(self.axes, self.structure, *subject)

    def entries(
        self, kind: str, why: EntryReason, statement: str, means_one: str, means_several: str
    ) -> Iterator[Fact]:
        """Yield the facts about entries of this kind; entries with the same reason share a sentence."""
        groups: dict[Reason, list[MassEntry]] = {}
        for entry in self.structure.entries:
            if entry.kind == kind:
                groups.setdefault(self._reason(why, entry), []).append(entry)
        # entries without a reason come last
        for reason, group in sorted(groups.items(), key=lambda item: item[0] is None):
            if reason is not None and self.axes is not None:
                # A reason names the other joint of each entry: the one closer to the root, unless it is prismatic.
                prismatic = self.axes.prismatic
                joints = sorted({entry.row if prismatic[entry.column] else entry.column for entry in group})
                reason = reason.format(axes=axes_in_words(joints), joints=joints_in_words(joints))
            names = listed([entry_name(entry.row, entry.column) for entry in group])
            if len(group) == 1:
                yield Fact(f"{names} is {statement}", means_one, reason)
            else:
                yield Fact(f"{names} are {statement}", means_several, reason)

    def equalities(self) -> Iterator[Fact]:
        """Yield entries that are equal or opposite at every configuration: they have the same terms."""
        terms: dict[tuple[int, int], dict[int, Fraction]] = {}
        for number, term in enumerate((*self.structure.outputs, *self.structure.constants)):
            for row, column, factor in term.basis:
                terms.setdefault((row, column), {})[number] = factor
        groups: dict[tuple[tuple[int, Fraction], ...], dict[tuple[int, int], bool]] = {}
        for entry, factors in sorted(terms.items()):
            # Entries are opposite if all factors are opposite: normalise the sign of the first factor.
            positive = next(iter(factors.values())) > 0
            if not positive:
                factors = {number: -factor for number, factor in factors.items()}
            groups.setdefault(tuple(factors.items()), {})[entry] = positive
        for signs in groups.values():
            if len(signs) > 1:
                entries = list(signs)
                names = ["-" * (signs[x] != signs[entries[0]]) + entry_name(*x) for x in entries]
                reason = self._reason(reasons.equality_reason, entries)
                yield Fact(f"{' = '.join(names)} always", "One of them is learned", reason)

    def idle_joints(self) -> Iterator[Fact]:
        """Yield joints that no entry of M depends on."""
        inputs: set[int] = set()
        for entry in self.structure.entries:
            inputs.update(entry.joints)
        if not inputs:
            return  # M is constant, which other facts state
        for joint in sorted(set(range(len(self.structure.joints))) - inputs):
            reason = self._reason(reasons.idle_reason, joint)
            yield Fact(
                f"M does not depend on joint {joint + 1}", "It is not an input of the networks of M", reason
            )

    def potential(self) -> Iterator[Fact]:
        if not self.structure.potential:
            yield Fact("V is zero", "It needs no network", self._reason(reasons.potential_reason))
            return
        # joints with the same reason share a sentence
        groups: dict[Reason, list[int]] = {}
        for joint in range(len(self.structure.joints)):
            if joint not in self.structure.potential:
                groups.setdefault(self._reason(reasons.weightless_reason, joint), []).append(joint)
        for reason, group in groups.items():
            inputs = "It is not an input" if len(group) == 1 else "They are not inputs"
            means = f"{inputs} of the network of V"
            yield Fact(f"V does not depend on {joints_in_words(group)}", means, reason)
