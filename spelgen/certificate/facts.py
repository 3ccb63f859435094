"""The structure of the mass matrix M and of the potential energy V as sentences (facts), with geometric reasons.

The facts are about zero, constant and equal entries of M, and about joints on which M or V does not depend. A reason is
given only if the exact geometry of the arm proves it. The entry M[a, b] is the integral of v_a . v_b over the mass that
joints a and b both move, where v_a is the velocity field for a unit velocity of joint a; the reasons are properties of
this integral.

A reason is a text, or None if no reason is found. One reason may be valid for several entries of M with one joint in
common, such as M[c, a] and M[c, b]. Its text then names joint c; the placeholder ``{joints}`` is replaced by joints a
and b, and ``{axes}`` by the axes of joints a and b.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction

from spelgen.arm.arm import Chain
from spelgen.certificate.axes import Axes, is_plain
from spelgen.labels import axes_in_words, entry_name, joints_in_words, listed
from spelgen.structure.structure import MassEntry, Structure

Reason = str | None
EntryReason = Callable[[Axes, MassEntry], Reason]


@dataclass(frozen=True)
class Fact:
    """A property of M or the potential energy V that is true at all configurations, as text.

    Attributes:
        statement: sentence with the property, such as "M21 is always zero".
        means: sentence with the consequence for the model.
        reason: geometric reason. None if the geometry gives no simple reason, or if the arm has branches or mimic
            joints; the property is nevertheless exact.
    """

    statement: str
    means: str
    reason: Reason

    def __str__(self) -> str:
        reason = f": {self.reason}" if self.reason else ""
        return f"{self.statement}{reason}. {self.means}."


def facts(arm: Chain, structure: Structure) -> tuple[Fact, ...]:
    """Return the facts about M and the potential energy V: properties at all q, with geometric reasons if found."""
    # Reasons are about pairs of joint axes, so they are not valid for a coordinate that moves several joints (mimic
    # joints).
    words = _Sentences(structure, Axes(arm, structure.assume) if is_plain(arm) else None)
    zero = ("always zero", "Nothing is learned for it", "Nothing is learned for them")
    constant = ("constant", "It needs one parameter and no network", "They need parameters and no networks")
    return (
        *words.entries("zero", zero_reason, *zero),
        *words.entries("constant", constant_reason, *constant),
        *words.equalities(),
        *words.idle_joints(),
        *words.potential(),
    )


@dataclass(frozen=True)
class _Sentences:
    """Generator of the facts about the structure of an arm.

    Attributes:
        structure: structure of the arm.
        axes: tests of the joint axes, from which the reason for a fact is derived, for example that two axes are
            parallel; None for an arm with branches or mimic joints, whose facts are given without reasons.
    """

    structure: Structure
    axes: Axes | None

    def _reason(self, why: Callable[..., Reason], *subject: object) -> Reason:
        return None if self.axes is None else why(self.axes, *subject)

    def entries(
        self, kind: str, why: EntryReason, statement: str, means_one: str, means_several: str
    ) -> Iterator[Fact]:
        """Yield facts about the zero or the constant entries of M: one fact for all entries with the same reason.

        Args:
            kind: "zero" or "constant".
            why: function of (`Axes`, entry of M) that returns the reason why the entry is zero or constant, or None.
            statement: end of the sentence about the entries, such as "always zero".
            means_one: consequence for the model, if the fact is about one entry.
            means_several: consequence for the model, if the fact is about several entries.
        """
        # Entries are grouped by reason: otherwise the same reason would be repeated for many entries.
        groups: dict[Reason, list[MassEntry]] = {}
        for entry in self.structure.entries:
            if entry.kind == kind:
                groups.setdefault(self._reason(why, entry), []).append(entry)
        # The entries of M whose value has no known geometric reason are listed last, after the explained ones.
        for reason, group in sorted(groups.items(), key=lambda item: item[0] is None):
            if reason is not None and self.axes is not None:
                # The text of a reason names one joint of the entry: a prismatic joint of the column, otherwise the
                # joint of the row. The placeholder in the text is replaced by the other joint, the row's joint in the
                # first case and the column's joint in the second case. (See `zero_reason` and `balance_reason`.)
                prismatic = self.axes.prismatic
                joints = sorted({entry.row if prismatic[entry.column] else entry.column for entry in group})
                reason = reason.format(axes=axes_in_words(joints), joints=joints_in_words(joints))
            names = listed([entry_name(entry.row, entry.column) for entry in group])
            verb, means = ("is", means_one) if len(group) == 1 else ("are", means_several)
            yield Fact(f"{names} {verb} {statement}", means, reason)

    def equalities(self) -> Iterator[Fact]:
        """Yield a fact for each set of entries of M that are equal, or opposite, at every configuration.

        Such entries have the same terms in the minimal form of M, with equal or opposite factors.
        """
        terms: dict[tuple[int, int], dict[int, Fraction]] = {}
        for number, term in enumerate((*self.structure.outputs, *self.structure.constants)):
            for row, column, factor in term.basis:
                terms.setdefault((row, column), {})[number] = factor
        groups: dict[tuple[tuple[int, Fraction], ...], dict[tuple[int, int], bool]] = {}
        for entry, factors in sorted(terms.items()):
            # An entry of M is a linear combination of the terms of M. If its first factor is negative, all its factors
            # are multiplied by -1: opposite entries are then in the same group.
            positive = next(iter(factors.values())) > 0
            if not positive:
                factors = {number: -factor for number, factor in factors.items()}
            groups.setdefault(tuple(factors.items()), {})[entry] = positive
        for signs in groups.values():
            if len(signs) > 1:
                entries = list(signs)
                names = ["-" * (signs[x] != signs[entries[0]]) + entry_name(*x) for x in entries]
                reason = self._reason(equality_reason, entries)
                yield Fact(f"{' = '.join(names)} always", "One of them is learned", reason)

    def idle_joints(self) -> Iterator[Fact]:
        """Yield a fact for each joint on which no entry of M depends."""
        inputs = {joint for entry in self.structure.entries for joint in entry.joints}
        if not inputs:
            return  # M is constant, as the facts about its entries state, so no joint is listed.
        for joint in sorted(set(range(len(self.structure.joints))) - inputs):
            means = "It is not an input of the networks of M"
            yield Fact(f"M does not depend on joint {joint + 1}", means, self._reason(idle_reason, joint))

    def potential(self) -> Iterator[Fact]:
        if not self.structure.potential:
            yield Fact("V is zero", "It needs no network", self._reason(potential_reason))
            return
        # Joints on which V does not depend for the same reason are listed in one fact.
        groups: dict[Reason, list[int]] = {}
        for joint in range(len(self.structure.joints)):
            if joint not in self.structure.potential:
                groups.setdefault(self._reason(weightless_reason, joint), []).append(joint)
        for reason, group in groups.items():
            inputs = "It is not an input" if len(group) == 1 else "They are not inputs"
            means = f"{inputs} of the network of V"
            yield Fact(f"V does not depend on {joints_in_words(group)}", means, reason)


def zero_reason(axes: Axes, entry: MassEntry) -> Reason:
    """Return the geometric reason why an entry of M is zero at all configurations; None if no reason is found."""
    later, earlier = entry.row, entry.column
    slider = later if axes.prismatic[later] else earlier
    if axes.prismatic[later] != axes.prismatic[earlier] and axes.parallel(later, earlier):
        parallel = f"prismatic joint {slider + 1} is parallel to {{axes}}"
        return f"{parallel}, and a rotation has no velocity along its axis"
    if axes.prismatic[later] and axes.prismatic[earlier] and axes.perpendicular(later, earlier):
        return f"prismatic joint {earlier + 1} is orthogonal to prismatic {{joints}}"
    return balance_reason(axes, entry)


def constant_reason(axes: Axes, entry: MassEntry) -> Reason:
    """Return the geometric reason why an entry of M is constant, as text, or None if no reason is found."""
    later, earlier = entry.row, entry.column
    if later == earlier:
        return _diagonal_reason(axes, later)
    if axes.prismatic[later] and axes.prismatic[earlier] and axes.fixed_angle(later, earlier):
        return "both joints are prismatic, and the angle between their axes is constant"
    if axes.prismatic[later] and not axes.prismatic[earlier] and axes.keep_offset(later, earlier):
        return (
            f"the load of joint {later + 1} keeps its distance from the plane that contains "
            f"{axes_in_words([earlier])} and is parallel to joint {later + 1}"
        )
    revolute = not axes.prismatic[later] and not axes.prismatic[earlier]
    if revolute and axes.same_twist(later, earlier) and _diagonal_reason(axes, later):
        same = entry_name(later, later)
        if axes.opposed(later, earlier):
            same = f"-{same}"
        return f"{joints_in_words([earlier, later])} are coaxial, so it equals {same}"
    return balance_reason(axes, entry)


def _diagonal_reason(axes: Axes, joint: int) -> Reason:
    # The diagonal entry of M is the inertia about the joint axis of all bodies that the joint carries (its load).
    # Joints nearer the root move axis and load together: only joints nearer the tip can change this inertia.
    behind = range(joint + 1, len(axes.prismatic))
    if axes.prismatic[joint]:
        return "the diagonal entry of a prismatic joint is the mass that it carries"
    if not behind:
        return f"joint {joint + 1} is the last and carries one rigid body"
    if all(axes.commute(joint, later) for later in behind):
        return f"all joints after joint {joint + 1} are coaxial revolute or parallel prismatic joints"
    if len(behind) == 1 and axes.symmetric:
        return f"the inertia of the load of joint {joint + 2} is symmetric about its axis"
    return None


def balance_reason(axes: Axes, entry: MassEntry) -> Reason:
    """Return the reason why an entry M[n, i] is constant or zero because the last body is dynamically balanced.

    n is the last joint. For a balanced last body, M[n, i] is Izz of the body times the cosine of the angle between the
    axes of joints n and i. Return None if the body is not balanced, or if the entry is in another row of M.
    """
    last, earlier = len(axes.prismatic) - 1, entry.column
    if not axes.balanced or entry.row != last:
        return None
    # A body that rotates about a principal axis through its centre of mass has angular momentum along this axis only.
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


def equality_reason(axes: Axes, entries: Sequence[tuple[int, int]]) -> Reason:
    """Return the geometric reason why entries in one row of M are equal or opposite; None if no reason is found.

    Let c be the joint of the row. The entry (c, k) of M is the generalised momentum of joint c if joint k moves at unit
    velocity. There are two possible reasons:

    - The joints of the columns are coaxial or, if prismatic, parallel. At unit velocity, each of these joints gives the
      bodies from c to the tip the same velocities, up to the sign.
    - Joint c is the last joint, its body is dynamically balanced about the axis of c (see `Axes`), and the joints of
      the columns are revolute and parallel. The entries then depend only on the angular velocities of the body, which
      are equal up to the sign.

    entries: (row, column) of each entry, counted from 0.
    """
    # Entries in different rows of M are integrals over different bodies: there is no simple reason for their equality.
    rows, columns = map(sorted, zip(*entries, strict=True))
    if rows[0] != rows[-1]:
        return None
    if all(axes.same_twist(columns[0], column) for column in columns[1:]):
        if axes.prismatic[columns[0]]:
            return f"prismatic {joints_in_words(columns)} are parallel"
        return f"{joints_in_words(columns)} are coaxial"
    last = len(axes.prismatic) - 1
    if entries[0][0] == last and axes.balanced:
        revolute = not any(axes.prismatic[column] for column in columns)
        if revolute and all(axes.parallel(columns[0], column) for column in columns[1:]):
            balanced = f"the load of joint {last + 1} is dynamically balanced"
            return f"{balanced}, and {joints_in_words(columns)} are parallel"
    return None


def idle_reason(axes: Axes, joint: int) -> Reason:
    """Return the geometric reason why M does not depend on the position of ``joint``; None if no reason is found."""
    if joint == 0:
        return "it moves the whole arm as one rigid body"
    # M does not depend on the position of the first joint, which moves the whole arm. If the motion of a joint commutes
    # with the motions of all joints nearer the root, it could be the first joint, and M does not depend on its
    # position.
    nearer = list(range(joint))
    if all(axes.commute(joint, earlier) for earlier in nearer):
        return f"its motion commutes with {joints_in_words(nearer)}, as if it were the first joint"
    if joint == len(axes.prismatic) - 1 and axes.symmetric:
        return "the inertia of its load is symmetric about its axis"
    return None


def weightless_reason(axes: Axes, joint: int) -> Reason:
    """Return the geometric reason why the potential energy V does not depend on ``joint``; None if none is found."""
    if axes.is_weightless(joint):
        if axes.prismatic[joint]:
            return "gravity does no work in a translation orthogonal to it"
        return "gravity does no work in a rotation about an axis parallel to it"
    last = joint == len(axes.prismatic) - 1
    if last and axes.centred:
        return "the centre of mass of its load is on its axis"
    return None


def potential_reason(axes: Axes) -> Reason:
    """Return the reason why the potential energy V is zero at all configurations; None if no reason is found."""
    if not any(axes.arm.gravity):
        return "gravity is zero"
    if all(axes.is_weightless(joint) for joint in range(len(axes.prismatic))):
        return "every axis is parallel to gravity if revolute, orthogonal to it if prismatic"
    return None
