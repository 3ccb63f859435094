"""`inspect` gives the expected statements about M and V, with reasons, for the project's robots and small arms."""

from __future__ import annotations

from fractions import Fraction

import pytest
from arms import STRAIGHT, chain

from spelgen.arm.arm import make_arm
from spelgen.certificate.axes import is_plain
from spelgen.certificate.facts import Fact, facts
from spelgen.certificate.inspection import inspect
from spelgen.structure.structure import derive
from spelgen.urdf.read import read_urdf

LAST = (
    "M{n}{n} is constant: joint {n} is the last and carries one rigid body. "
    "It needs one parameter and no network."
)
ROOT = (
    "M does not depend on joint 1: it moves the whole arm as one rigid body. "
    "It is not an input of the networks of M."
)
UPRIGHT = (
    "V does not depend on joint 1: gravity does no work in a rotation about an axis parallel to it. "
    "It is not an input of the network of V."
)
SIX_AXES = [LAST.format(n=6), ROOT, UPRIGHT]
WORDS = {
    "two_link": [LAST.format(n=2), ROOT],
    "rpr": [
        "M32 is always zero: prismatic joint 2 is parallel to the axis of joint 3, and a rotation has no velocity "
        "along its axis. Nothing is learned for it.",
        "M22 is constant: the diagonal entry of a prismatic joint is the mass that it carries. "
        "It needs one parameter and no network.",
        LAST.format(n=3),
        ROOT,
        UPRIGHT,
        "V does not depend on joint 2: gravity does no work in a translation orthogonal to it. "
        "It is not an input of the network of V.",
    ],
    "scara": [
        "M31, M32 and M43 are always zero: prismatic joint 3 is parallel to the axes of joints 1, 2 and 4, and a "
        "rotation has no velocity along its axis. Nothing is learned for them.",
        "M33 is constant: the diagonal entry of a prismatic joint is the mass that it carries. "
        "It needs one parameter and no network.",
        LAST.format(n=4),
        ROOT,
        "M does not depend on joint 3: its motion commutes with joints 1 and 2, as if it were the first joint. "
        "It is not an input of the networks of M.",
        "V does not depend on joints 1, 2 and 4: gravity does no work in a rotation about an axis parallel to it. "
        "They are not inputs of the network of V.",
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


def test_words_with_the_inertials_of_the_file(robots):
    told = [str(fact) for fact in inspect(robots / "ur10e.urdf", assume="inertials").facts]
    assert told == [
        "M65 is always zero: the load of joint 6 is dynamically balanced about its axis, which is orthogonal to the "
        "axis of joint 5. Nothing is learned for it.",
        LAST.format(n=6),
        "M62 = M63 = M64 always: the load of joint 6 is dynamically balanced, and joints 2, 3 and 4 are parallel. "
        "One of them is learned.",
        ROOT,
        UPRIGHT,
        "V does not depend on joint 6: the centre of mass of its load is on its axis. "
        "It is not an input of the network of V.",
    ]


def test_two_turns_about_one_line():
    """If the axes of joints 1 and 2 lie on the same line with opposite directions, M21 = -M22.

    The stated reason is that the joints are coaxial.
    """
    over = tuple(tuple(Fraction(x) for x in row) for row in ((1, 0, 0), (0, -1, 0), (0, 0, -1)))
    arm = chain([("revolute", STRAIGHT, (0, 0, 0)), ("revolute", over, (0, 0, 0.5))])
    told = {fact.statement: fact.reason for fact in facts(arm, derive(arm))}
    assert told["M21 is constant"] == "joints 1 and 2 are coaxial, so it equals -M22"
    assert told["M21 = -M22 always"] == "joints 1 and 2 are coaxial"
    assert (
        told["M11 is constant"]
        == "all joints after joint 1 are coaxial revolute or parallel prismatic joints"
    )
    assert told["V is zero"] == "every axis is parallel to gravity if revolute, orthogonal to it if prismatic"


def test_no_gravity_no_potential():
    arm = chain([("prismatic", STRAIGHT, (0, 0, 0))], gravity=(0, 0, 0))
    assert Fact("V is zero", "It needs no network", "gravity is zero") in facts(arm, derive(arm))


def test_mimic_joints_get_no_reasons(shared):
    arm = make_arm(read_urdf(shared / "arms" / "abb_irb5400.urdf"))
    assert not is_plain(arm)
    told = facts(arm, derive(arm))
    assert told[0] == Fact("M66 is constant", "It needs one parameter and no network", None)
    assert str(told[0]) == "M66 is constant. It needs one parameter and no network."
    assert not any(fact.reason for fact in told)
