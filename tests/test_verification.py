"""The numerical verification confirms the derived structure and reports each false statement."""

import re
from dataclasses import replace
from fractions import Fraction

import pytest

from spelgen.arm.configured_arm import load_arm
from spelgen.certificate.verify import verify
from spelgen.structure.structure import MassEntry, derive

ROBOTS = ("two_link", "rpr", "six_dof", "scara", "panda", "ur10e")


@pytest.fixture(scope="module")
def rpr(robots):
    return load_arm(robots / "rpr.urdf")


@pytest.fixture(scope="module")
def true(rpr):
    return derive(rpr.chain)


@pytest.mark.parametrize("assume", ["kinematics", "inertials"])
@pytest.mark.parametrize("name", ROBOTS)
def test_the_derived_structure_is_confirmed(robots, name, assume):
    loaded = load_arm(robots / f"{name}.urdf")
    proof = verify(loaded.robot, loaded.chain, derive(loaded.chain, assume))
    assert proof.agrees, proof.text()
    assert {check.verdict for check in proof.checks} == {"agrees"}
    assert proof.samples > len(loaded.chain.coordinates)


def entry(structure, row, column, kind, joints=()):
    """Return the structure with one entry of M changed to another kind."""
    entries = tuple(
        MassEntry(row, column, kind, joints) if (x.row, x.column) == (row, column) else x
        for x in structure.entries
    )
    return replace(structure, entries=entries)


def halved(weights):
    return tuple((row, column, value / Fraction(2)) for row, column, value in weights)


# {name: (function that makes a statement of the structure of `rpr` false, word in the check that must report it)};
# rpr: arm with a revolute, a prismatic and a revolute joint; "V|potential": either word
LIES = {
    "a zero that is none": (lambda s: entry(s, 2, 0, "zero"), "M31"),
    "a constant that varies": (lambda s: entry(s, 0, 0, "constant"), "M11"),
    "a zero called varying": (lambda s: entry(s, 2, 1, "varying", (1, 2)), "M32"),
    "a joint forgotten": (lambda s: entry(s, 0, 0, "varying", (1,)), "M11"),
    "a joint too many": (lambda s: entry(s, 1, 0, "varying", (1, 2)), "M21"),
    "an output too few": (lambda s: replace(s, outputs=s.outputs[:-1]), "output"),
    "an output too many": (lambda s: replace(s, outputs=(*s.outputs, s.outputs[0])), "output"),
    "a constant too few": (lambda s: replace(s, constants=s.constants[:-1]), "constant"),
    "an output that enters M half": (
        lambda s: replace(
            s, outputs=(replace(s.outputs[0], basis=halved(s.outputs[0].basis)), *s.outputs[1:])
        ),
        "form",
    ),
    "an output of fewer joints": (
        lambda s: replace(s, outputs=tuple(replace(x, joints=(2,)) for x in s.outputs)),
        "output",
    ),
    "no gravity": (lambda s: replace(s, potential=()), "V|potential"),
    "gravity on a level joint": (lambda s: replace(s, potential=(0, *s.potential)), "V|potential"),
    "a base parameter too few": (
        lambda s: replace(s, base_parameter_count=s.base_parameter_count - 1),
        "base",
    ),
    "a base parameter too many": (
        lambda s: replace(s, base_parameter_count=s.base_parameter_count + 1),
        "base",
    ),
}


@pytest.mark.parametrize("lie", LIES)
def test_false_statements_are_reported(rpr, true, lie):
    told, words = LIES[lie]
    proof = verify(rpr.robot, rpr.chain, told(true))
    assert not proof.agrees
    assert any(word in str(check) for check in proof.differences for word in words.split("|")), proof.text()


def test_an_arm_that_is_not_the_file_s_is_reported(rpr, true):
    first, *rest = rpr.chain.bodies
    moved = replace(first, translation=(first.translation[0] + Fraction(1, 100), *first.translation[1:]))
    arm = replace(rpr.chain, bodies=(moved, *rest))
    assert not verify(rpr.robot, arm, derive(arm)).agrees


def test_same_seed_same_proof(rpr, true):
    assert verify(rpr.robot, rpr.chain, true) == verify(rpr.robot, rpr.chain, true)
    assert verify(rpr.robot, rpr.chain, true, seed=1) != verify(rpr.robot, rpr.chain, true)


def test_a_negative_mass_leaves_the_reading_undecided(robots, tmp_path):
    """With a negative mass, which Pinocchio reads differently, the comparison is "undecided", not a contradiction."""
    path = tmp_path / "arm.urdf"
    text = (robots / "rpr.urdf").read_text()
    path.write_text(re.sub('<mass value="', '<mass value="-', text, count=1))
    loaded = load_arm(path)
    checks = verify(loaded.robot, loaded.chain, derive(loaded.chain)).checks
    assert [x.verdict for x in checks if x.verdict != "agrees"] == ["undecided"]
    assert "negative mass of a link" in str(checks[-1])
