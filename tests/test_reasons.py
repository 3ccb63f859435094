"""Statements and reasons of the inspection agree with numbers by Pinocchio."""

from __future__ import annotations

import re
from collections.abc import Callable
from fractions import Fraction

import numpy as np
import pytest
from arms import STRAIGHT, chain, reference_arms
from pinocchio_geometry import NOTHING, Seen

from spelgen.arm.arm import Chain, make_arm
from spelgen.certificate.axes import is_plain
from spelgen.certificate.facts import Fact, facts
from spelgen.certificate.inspection import inspect
from spelgen.certificate.numeric_samples import draw
from spelgen.structure.recursion import triangle
from spelgen.structure.structure import Structure, derive
from spelgen.urdf.read import read_urdf

LAST = (
    "M{n}{n} is constant: joint {n} is the last, so the inertia about its axis stays the same. "
    "It needs a number, no network."
)
ROOT = "M does not depend on joint 1: it moves the whole arm as one piece. No network of M reads it."
UPRIGHT = "V does not depend on joint 1: turning about the vertical lifts nothing. The network of V does not read it."
SIX_AXES = [LAST.format(n=6), ROOT, UPRIGHT]
WORDS = {
    "two_link": [LAST.format(n=2), ROOT],
    "rpr": [
        "M32 is always zero: joint 2 slides along the axis of joint 3, and what turns about an axis never moves "
        "along it. Nothing is learned for it.",
        "M22 is constant: for a sliding joint the entry is the mass that it carries. It needs a number, no network.",
        LAST.format(n=3),
        ROOT,
        UPRIGHT,
        "V does not depend on joint 2: sliding level lifts nothing. The network of V does not read it.",
    ],
    "scara": [
        "M31, M32 and M43 are always zero: joint 3 slides along the axes of joints 1, 2 and 4, and what turns about an "
        "axis never moves along it. Nothing is learned for them.",
        "M33 is constant: for a sliding joint the entry is the mass that it carries. It needs a number, no network.",
        LAST.format(n=4),
        ROOT,
        "M does not depend on joint 3: it does not move the axes of joints 1 and 2, as if it moved the whole arm. "
        "No network of M reads it.",
        "V does not depend on joints 1, 2 and 4: turning about the vertical lifts nothing. "
        "The network of V does not read them.",
    ],
    "six_dof": SIX_AXES,
    "ur10e": SIX_AXES,
    "panda": [LAST.format(n=7), ROOT, UPRIGHT],
}


@pytest.mark.parametrize("robot", WORDS)
def test_words_about_the_own_robots(robots, robot):
    found = inspect(robots / f"{robot}.urdf")
    assert [str(fact) for fact in found.facts] == WORDS[robot]
    assert [fact["statement"] for fact in found.to_dict()["facts"]] == [
        fact.statement for fact in found.facts
    ]
    assert " ".join(WORDS[robot]) in " ".join(found.text().split())


def test_words_when_the_inertials_are_believed(robots):
    told = [str(fact) for fact in inspect(robots / "ur10e.urdf", assume="inertials").facts]
    assert told == [
        "M65 is always zero: what joint 6 carries is balanced about its axis, which is always at right angles to the "
        "axis of joint 5. Nothing is learned for it.",
        LAST.format(n=6),
        "M62 = M63 = M64 always: what joint 6 carries is balanced about its axis, and joints 2, 3 and 4 are parallel. "
        "One of them is learned.",
        ROOT,
        UPRIGHT,
        "V does not depend on joint 6: the centre of the mass that it carries lies on its axis. "
        "The network of V does not read it.",
    ]


def test_two_turns_about_one_line():
    """The second turns against the first, so their coupling is minus the inertia."""
    over = tuple(tuple(Fraction(x) for x in row) for row in ((1, 0, 0), (0, -1, 0), (0, 0, -1)))
    arm = chain([("revolute", STRAIGHT, (0, 0, 0)), ("revolute", over, (0, 0, 0.5))])
    told = {fact.statement: fact.reason for fact in facts(arm, derive(arm))}
    assert told["M21 is constant"] == "joints 1 and 2 turn about one line, so it is -M22"
    assert told["M21 = -M22 always"] == "joints 1 and 2 turn about one line"
    assert told["M11 is constant"] == "all joints after joint 1 turn about its axis or slide along it"
    assert (
        told["V is zero"]
        == "every joint turns about gravity's direction or slides across it, which lifts nothing"
    )


def test_no_gravity_no_potential():
    arm = chain([("prismatic", STRAIGHT, (0, 0, 0))], gravity=(0, 0, 0))
    assert Fact("V is zero", "It needs no network", "so is gravity") in facts(arm, derive(arm))


def test_where_bodies_share_a_coordinate_no_reason_is_sought(shared):
    arm = make_arm(read_urdf(shared / "arms" / "abb_irb5400.urdf"))
    assert not is_plain(arm)
    told = facts(arm, derive(arm))
    assert told[0] == Fact("M66 is constant", "It needs a number, no network", None)
    assert str(told[0]) == "M66 is constant. It needs a number, no network."
    assert not any(fact.reason for fact in told)


@pytest.mark.parametrize("assume", ["kinematics", "inertials"])
def test_reference_arms(shared, assume):
    """On every arm of the reference set each statement and each reason holds by numbers, and none is missing."""
    reasons = set()
    for name, _, arm, structure in reference_arms(shared, assume):
        told = facts(arm, structure)
        assert_statements_hold(arm, structure, told, name)
        seen = Seen(arm) if arm.inertials_complete else None
        for fact in told:
            if fact.reason is not None:
                reasons.add(re.sub(r"\d+", "#", fact.reason))
                assert seen is None or holds(seen, fact), (name, str(fact))
    assert len(reasons) > 12


def assert_statements_hold(arm: Chain, structure: Structure, told: tuple[Fact, ...], name: str) -> None:
    """Every reason is true in Pinocchio at random configurations, with random inertials or the URDF's."""
    keys = triangle(len(structure.joints))
    free = structure.assume == "kinematics"
    samples = draw(arm, 4 if free else 6, np.random.default_rng(0), random_inertials=free)
    names = {_entry(row, column): k for k, (row, column) in enumerate(keys)}
    mass, changes = samples.mass * samples.scale, np.abs(samples.changes)
    lifted = np.abs(samples.gravity.T)
    of_kind: dict[str, set[str]] = {"zero": set(), "constant": set()}
    idle = set()
    for fact in told:
        entries = [names[entry] for entry in re.findall(r"M\d[\d,]*\d", fact.statement)]
        numbers = [int(number) - 1 for number in re.findall(r"\b\d+\b", fact.statement)]
        if "zero" in fact.statement and entries:
            of_kind["zero"] |= {_entry(*keys[k]) for k in entries}
            good = np.abs(samples.mass[..., entries]).max() < NOTHING
        elif "constant" in fact.statement:
            of_kind["constant"] |= {_entry(*keys[k]) for k in entries}
            good = changes[..., entries].max() < NOTHING
        elif "=" in fact.statement:
            signs = [-1 if part.startswith("-") else 1 for part in re.findall(r"-?M", fact.statement)]
            alike = mass[..., entries] * signs
            good = np.abs(alike - alike[..., :1]).max() < NOTHING * samples.scale[entries].max()
        elif fact.statement.startswith("M does not depend"):
            idle |= set(numbers)
            good = changes[numbers].max() < NOTHING
        else:
            good = lifted[numbers or slice(None)].max() < NOTHING
        assert good, (name, str(fact))
    for kind, found in of_kind.items():
        assert found == {_entry(e.row, e.column) for e in structure.entries if e.kind == kind}, name
    used = {joint for entry in structure.entries for joint in entry.joints}
    assert idle == (set(range(len(structure.joints))) - used if used else set()), name


def _entry(row: int, column: int) -> str:
    return f"M{row + 1}{column + 1}"


def _steady(values: np.ndarray) -> bool:
    return bool(np.ptp(values, axis=0).max() < NOTHING)


Check = Callable[[Seen, list[int], list[int]], bool]

# A reason, # for a joint and ## for several -> whether it holds: of the joints in the statement and in it.
# Entries count as two joints each in the statement: M32 as 3, 2.
CHECKS: dict[str, Check] = {
    "it moves the whole arm as one piece": lambda s, about, _: about == [1],
    "turning about the vertical lifts nothing": lambda s, about, _: (
        s.turns(*about) and all(s.lifts_nothing(k) for k in about)
    ),
    "sliding level lifts nothing": lambda s, about, _: (
        s.slides(*about) and all(s.lifts_nothing(k) for k in about)
    ),
    "every joint turns about gravity's direction or slides across it, which lifts nothing": lambda s, *_: all(
        s.lifts_nothing(k + 1) for k in range(s.n)
    ),
    "joint # is the last, so the inertia about its axis stays the same": lambda s, about, named: (
        about == [s.n, s.n] == 2 * named and s.turns(s.n)
    ),
    "the centre of the mass that it carries lies on its axis": lambda s, about, _: (
        about == [s.n] and s.turns(s.n) and np.abs(s.lever[:2]).max() < NOTHING
    ),
    "what joint # carries is balanced about its axis, which is always at right angles to the ax[ie]s of ##": (
        lambda s, about, named: (
            (s.balanced and named[0] == s.n and about[::2] == [s.n] * (len(named) - 1))
            and (about[1::2] == named[1:] and np.abs(s.cosines(s.n, named[1:])).max() < NOTHING)
        )
    ),
    "what joint # carries is balanced about its axis, which keeps its angle to the ax[ie]s of ##": (
        lambda s, about, named: (
            s.balanced and about == [s.n, *named[1:]] and _steady(s.cosines(s.n, named[1:]))
        )
    ),
    "what joint # carries is balanced about its axis and has no moment of inertia about it": (
        lambda s, about, named: s.balanced and set(about[::2]) == {s.n} == set(named) and s.inertia[2, 2] == 0
    ),
    "what joint # carries is balanced about its axis, and ## are parallel": lambda s, about, named: (
        s.balanced and named[0] == s.n and about[1::2] == named[1:] and s.parallel(*named[1:])
    ),
    "what joint # carries is symmetric about its axis": lambda s, about, named: (
        s.symmetric and named == [s.n] and about == [s.n - 1, s.n - 1]
    ),
    "what it carries is symmetric about its axis": lambda s, about, _: s.symmetric and about == [s.n],
    "for a sliding joint the entry is the mass that it carries": lambda s, about, _: all(
        s.slides(k) and np.allclose(s.mass(k), s.mass_behind(k), rtol=1e-12) for k in about
    ),
    "it does not move the ax[ie]s of ##, as if it moved the whole arm": lambda s, about, named: (
        named == list(range(1, about[0])) and s.commute(about[0], named)
    ),
    "joint # slides along the ax[ie]s of ##, and what turns about an axis never moves along it": (
        lambda s, about, named: (
            s.slides(named[0])
            and s.turns(*named[1:])
            and s.parallel(*named)
            and {*about} == {*named}
            and all(named[0] in pair for pair in zip(about[::2], about[1::2], strict=True))
        )
    ),
    "joint # slides at right angles to ##": lambda s, about, named: (
        s.slides(*named)
        and np.abs(s.cosines(named[0], named[1:])).max() < NOTHING
        and all(named[0] in pair for pair in zip(about[::2], about[1::2], strict=True))
    ),
    "the two slide at a fixed angle, and the mass that both move does not change": lambda s, about, _: all(
        s.slides(a, b) and _steady(s.cosines(a, [b])) for a, b in zip(about[::2], about[1::2], strict=True)
    ),
    "the mass that joint # carries keeps its distance from the plane through the axis of joint # along its slide": (
        lambda s, about, named: (
            (about == named and s.slides(named[0]) and s.turns(named[1])) and _steady(s.carried(*named))
        )
    ),
    "all joints after joint # turn about its axis or slide along it": lambda s, about, named: (
        about == 2 * named
        and all(
            s.one_line(named[0], k) if s.turns(k) else s.parallel(named[0], k)
            for k in range(named[0] + 1, s.n + 1)
        )
    ),
    "## slide along one direction": lambda s, about, named: (
        about[1::2] == named and s.slides(*named) and s.parallel(*named)
    ),
    "## turn about one line": lambda s, about, named: (
        about[1::2] == named and s.turns(*named) and s.one_line(*named)
    ),
}


def holds(seen: Seen, fact: Fact) -> bool:
    """Whether the reason is one that can be checked, and holds."""
    about = [int(digit) for digit in re.findall(r"\d", fact.statement)]
    named = [int(number) for number in re.findall(r"\d+", fact.reason)]
    some = r"joints? \d+(?:, \d+)*(?: and \d+)?"
    for pattern, check in CHECKS.items():
        if re.fullmatch(pattern.replace("##", some).replace("#", r"\d+"), fact.reason):
            return bool(check(seen, about, named))
    return False
