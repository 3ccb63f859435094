"""The structure of all reference arms is the known one, and Pinocchio confirms its statements and reasons.

The derivation takes most of the time of both tests, so each arm is derived once per process.
"""

from __future__ import annotations

import re
from collections.abc import Callable

import numpy as np
import pytest
from arms import reference_arms
from pinocchio_geometry import NOTHING, Seen

from spelgen.arm.arm import Chain
from spelgen.certificate.facts import Fact, facts
from spelgen.certificate.numeric_samples import draw
from spelgen.structure.recursion import triangle
from spelgen.structure.structure import Structure

REFERENCE_ARMS = {"kinematics": 189, "inertials": 152}
# expected.json has other values for these arms, since its numerical ranks depend on a tolerance (docs/structure.md)
TOLERANCE_CASES = {
    ("edo", "kinematics"): {"outputs_only_from_joint"},
    ("kuka_iiwa14_lbrstack", "inertials"): {"outputs"},
    ("kuka_iiwa7_lbrstack", "inertials"): {"outputs"},
    ("kuka_med14_lbrstack", "inertials"): {"outputs"},
}


@pytest.mark.parametrize("assume", ["kinematics", "inertials"])
def test_structure_is_the_known_one(shared, assume):
    """The derived structure of each reference arm equals the known one, fact by fact."""
    wrong, names = {}, set()
    for name, known, _, structure in reference_arms(shared, assume):
        names.add(name)
        got = _facts(structure)
        differing = {key for key, value in known.items() if got[key] != value}
        if differing != TOLERANCE_CASES.get((name, assume), set()):
            wrong[name] = {key: (got[key], known[key]) for key in differing}
    assert not wrong
    assert len(names) == REFERENCE_ARMS[assume]


@pytest.mark.parametrize("assume", ["kinematics", "inertials"])
def test_statements_and_reasons_hold_by_numbers(shared, assume):
    """Each statement of `facts` about a reference arm (shared/arms) holds numerically, and so does its reason.

    The statements name all zero and constant entries of M. Reasons are tested if the URDF has all inertials.
    """
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
    """Assert by Pinocchio, at random configurations, that the statements about an arm hold and are complete.

    Inertial values are random, or the URDF's if the structure assumes them.
    """
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

# {reason: function that returns True if the reason holds}. In a reason, # is a joint, and ## are several joints. The
# arguments of a function are the arm, the joints in the statement (3 and 2 for M32), and the joints in the reason.
CHECKS: dict[str, Check] = {
    "it moves the whole arm as one rigid body": lambda s, about, _: about == [1],
    "gravity does no work in a rotation about an axis parallel to it": lambda s, about, _: (
        s.turns(*about) and all(s.lifts_nothing(k) for k in about)
    ),
    "gravity does no work in a translation orthogonal to it": lambda s, about, _: (
        s.slides(*about) and all(s.lifts_nothing(k) for k in about)
    ),
    "every axis is parallel to gravity if revolute, orthogonal to it if prismatic": lambda s, *_: all(
        s.lifts_nothing(k + 1) for k in range(s.n)
    ),
    "joint # is the last and carries one rigid body": lambda s, about, named: (
        about == [s.n, s.n] == 2 * named and s.turns(s.n)
    ),
    "the centre of mass of its load is on its axis": lambda s, about, _: (
        about == [s.n] and s.turns(s.n) and np.abs(s.lever[:2]).max() < NOTHING
    ),
    "the load of joint # is dynamically balanced about its axis, which is orthogonal to the ax[ie]s of ##": (
        lambda s, about, named: (
            (s.balanced and named[0] == s.n and about[::2] == [s.n] * (len(named) - 1))
            and (about[1::2] == named[1:] and np.abs(s.cosines(s.n, named[1:])).max() < NOTHING)
        )
    ),
    "the load of joint # is dynamically balanced about its axis, which has a constant angle to the ax[ie]s of ##": (
        lambda s, about, named: (
            s.balanced and about == [s.n, *named[1:]] and _steady(s.cosines(s.n, named[1:]))
        )
    ),
    "the load of joint # is dynamically balanced, and its inertia about the joint axis is zero": (
        lambda s, about, named: s.balanced and set(about[::2]) == {s.n} == set(named) and s.inertia[2, 2] == 0
    ),
    "the load of joint # is dynamically balanced, and ## are parallel": lambda s, about, named: (
        s.balanced and named[0] == s.n and about[1::2] == named[1:] and s.parallel(*named[1:])
    ),
    "the inertia of the load of joint # is symmetric about its axis": lambda s, about, named: (
        s.symmetric and named == [s.n] and about == [s.n - 1, s.n - 1]
    ),
    "the inertia of its load is symmetric about its axis": lambda s, about, _: s.symmetric and about == [s.n],
    "the diagonal entry of a prismatic joint is the mass that it carries": lambda s, about, _: all(
        s.slides(k) and np.allclose(s.mass(k), s.mass_behind(k), rtol=1e-12) for k in about
    ),
    "its motion commutes with ##, as if it were the first joint": lambda s, about, named: (
        named == list(range(1, about[0])) and s.commute(about[0], named)
    ),
    "prismatic joint # is parallel to the ax[ie]s of ##, and a rotation has no velocity along its axis": (
        lambda s, about, named: (
            s.slides(named[0])
            and s.turns(*named[1:])
            and s.parallel(*named)
            and {*about} == {*named}
            and all(named[0] in pair for pair in zip(about[::2], about[1::2], strict=True))
        )
    ),
    "prismatic joint # is orthogonal to prismatic ##": lambda s, about, named: (
        s.slides(*named)
        and np.abs(s.cosines(named[0], named[1:])).max() < NOTHING
        and all(named[0] in pair for pair in zip(about[::2], about[1::2], strict=True))
    ),
    "both joints are prismatic, and the angle between their axes is constant": lambda s, about, _: all(
        s.slides(a, b) and _steady(s.cosines(a, [b])) for a, b in zip(about[::2], about[1::2], strict=True)
    ),
    "the load of joint # keeps its distance from the plane that contains the axis of joint # and is parallel to "
    "joint #": (
        lambda s, about, named: (
            (about == named[:2] and named[2] == named[0] and s.slides(named[0]) and s.turns(named[1]))
            and _steady(s.carried(*named[:2]))
        )
    ),
    "all joints after joint # are coaxial revolute or parallel prismatic joints": lambda s, about, named: (
        about == 2 * named
        and all(
            s.one_line(named[0], k) if s.turns(k) else s.parallel(named[0], k)
            for k in range(named[0] + 1, s.n + 1)
        )
    ),
    "prismatic ## are parallel": lambda s, about, named: (
        about[1::2] == named and s.slides(*named) and s.parallel(*named)
    ),
    "## are coaxial": lambda s, about, named: about[1::2] == named and s.turns(*named) and s.one_line(*named),
}


def holds(seen: Seen, fact: Fact) -> bool:
    """Return True if the table `CHECKS` has a test for the text `fact.reason`, and the arm passes this test.

    seen: axes and masses of the arm at random configurations, by Pinocchio. fact: statement on M or V, with a reason.
    """
    about = [int(digit) for digit in re.findall(r"\d", fact.statement)]
    named = [int(number) for number in re.findall(r"\d+", fact.reason)]
    some = r"joints? \d+(?:, \d+)*(?: and \d+)?"
    for pattern, check in CHECKS.items():
        if re.fullmatch(pattern.replace("##", some).replace("#", r"\d+"), fact.reason):
            return bool(check(seen, about, named))
    return False


def _facts(structure: Structure) -> dict:
    letters = {"zero": "Z", "constant": "C", "varying": "V"}
    n = len(structure.joints)
    entries = {(e.row, e.column): e for e in structure.entries}
    return {
        "kinds": [
            "".join(letters[entries[row, column].kind] for column in range(row + 1)) for row in range(n)
        ],
        "joints": {
            f"{e.row + 1},{e.column + 1}": [k + 1 for k in e.joints]
            for e in structure.entries
            if e.kind == "varying"
        },
        "potential": [k + 1 for k in structure.potential],
        "outputs": len(structure.outputs),
        "constants": len(structure.constants),
        "outputs_only_from_joint": [structure.outputs_from(k) for k in range(n)],
        "base_parameters": structure.base_parameter_count,
    }
