"""Closed forms written as text and SymPy file equal M and V of Pinocchio."""

from __future__ import annotations

import json
import subprocess
import sys
from functools import cache
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
import sympy
from formula_parsing import assert_close, assert_equal_to_pinocchio, read_back
from hypothesis import HealthCheck, given, settings
from random_arms import arms

from spelgen.arm.arm import make_arm
from spelgen.arm.configured_arm import load_arm
from spelgen.certificate.formula_files import sympy_source, text
from spelgen.certificate.formulas import WRITABLE, formulas
from spelgen.certificate.inspection import inspect
from spelgen.certificate.numeric_samples import with_random_inertias
from spelgen.files import write_text
from spelgen.structure.expansion import Expansion
from spelgen.structure.structure import derive
from spelgen.urdf.read import read_urdf

ROOT = Path(__file__).parents[1]
ROBOTS = ("two_link", "rpr", "scara", "six_dof", "ur10e")

RUN_ALONE = """
import json, sys
sys.path.insert(0, ".")
sys.modules["spelgen"] = None  # cannot be imported
import closed_forms as f
import sympy
names, numbers = list(f.values), [float(value) for value in f.values.values()]
matrix = sympy.lambdify([*f.q, *names], f.M.tolist(), "math")
energy = sympy.lambdify([*f.q, *names], f.V, "math")
found = [[matrix(*q, *numbers), energy(*q, *numbers)] for q in json.loads(sys.argv[1])]
assert set(names) == set(f.base_parameters)
print(json.dumps(found))
"""


@cache
def written(robot, assume="kinematics"):
    """Return one of the project's arms, its structure, and its closed forms, with all entries expanded."""
    arm = load_arm(ROOT / "robots" / f"{robot}.urdf").chain
    structure = derive(arm, assume)
    return arm, structure, formulas(arm, structure, longest=WRITABLE)


@pytest.mark.parametrize("robot", ROBOTS)
def test_the_sympy_file_by_itself_equals_pinocchio(robots, robot, tmp_path):
    """The SymPy file runs without spelgen, and its M and V equal M and V of Pinocchio for the URDF."""
    arm, _, found = written(robot)
    write_text(tmp_path / "closed_forms.py", sympy_source(found))
    model = pin.buildModelFromUrdf(str(robots / f"{robot}.urdf"))
    model.gravity.linear = np.array(arm.gravity, dtype=float)
    points = np.random.default_rng(0).uniform(-2, 2, (3, model.nq))
    command = [sys.executable, "-I", "-c", RUN_ALONE, json.dumps(points.tolist())]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    masses, energies = zip(*json.loads(done.stdout), strict=True)
    data = model.createData()
    for q, mass in zip(points, masses, strict=True):
        upper = np.triu(pin.crba(model, data, q))
        assert_close(mass, upper + np.triu(upper, 1).T)
    true = [pin.computePotentialEnergy(model, data, q) for q in points]
    assert_close(np.diff(energies), np.diff(true))


@pytest.mark.parametrize("assume", ["kinematics", "inertials"])
@pytest.mark.parametrize("robot", ROBOTS)
def test_text_read_back_equals_pinocchio(robot, assume):
    """The text of closed forms, evaluated as Python, equals Pinocchio.

    Under ``kinematics`` this holds for any inertial values, under ``inertials`` for the URDF's.
    """
    arm, _, found = written(robot, assume)
    assert not found.unwritten
    if assume == "kinematics":
        arm = with_random_inertias(arm, np.random.default_rng(1))
    assert_equal_to_pinocchio(arm, read_back(text(found)))


@pytest.mark.parametrize("robot", ["two_link", "rpr", "scara"])
def test_sympy_proves_each_expression(robot):
    """Each shortened expression equals its full expansion exactly, proved by SymPy in sines and cosines."""
    arm, _, found = written(robot)
    expansion = Expansion(arm, budget=10**9)
    generators = [function for q in found.q for function in (sympy.sin(q), sympy.cos(q), q)]
    circles = [sympy.cos(q) ** 2 + sympy.sin(q) ** 2 - 1 for q in found.q]
    for row in found.rows:
        element = expansion.energies.potential
        if row.entry != "V":
            element = expansion.energies.mass[row.entry[0] - 1, row.entry[1] - 1]
        expanded = sympy.Integer(0)
        for each in found.base:
            polynomial = expansion.polynomial(element, each.index)
            for powers, share in polynomial.terms():
                if row.entry != "V" or any(powers):  # without the constant of V, since it is arbitrary
                    monomial = sympy.prod(x**power for x, power in zip(generators, powers, strict=True))
                    expanded += (
                        sympy.Rational(int(share.p), int(share.q))
                        * sympy.Symbol(each.name, real=True)
                        * monomial
                    )
        difference = sympy.expand(sympy.expand_trig(row.expression.doit()) - expanded)
        assert sympy.reduced(difference, circles, *generators)[1] == 0, row.name


def test_python_users_get_sympy(robots):
    """`inspect(path).closed_forms()` returns symbols, entries, M and V that SymPy can differentiate and simplify."""
    found = inspect(robots / "rpr.urdf").closed_forms()
    q1, q2, q3 = found.q
    names = {symbol.name: symbol for symbol in found.base_parameters}
    m2r, hz2r, ixx3r, ixy3 = (names[name] for name in ("m2R", "hz2R", "Ixx3R", "Ixy3"))
    m11 = found.entries[1, 1]
    assert set(found.entries) == {(1, 1), (2, 1), (2, 2), (3, 1), (3, 2), (3, 3)}
    assert sympy.diff(m11, q2) == 2 * m2r * q2 + 2 * hz2r
    assert sympy.simplify(sympy.diff(m11, q3) + ixx3r * sympy.sin(2 * q3) + 2 * ixy3 * sympy.cos(2 * q3)) == 0
    assert sympy.diff(found.potential, q1) == 0
    assert str(found.base_parameters[m2r]) == "m2 + m3" and found.values[m2r] == sympy.Rational("5.33")
    assert found.mass_matrix.shape == (3, 3) and found.mass_matrix[0, 0] == m11
    assert repr(found) == "<Formulas of 'rpr': 7 written, in 11 base parameters>"
    assert "M32</td>" in found._repr_html_() and ">m2R</td>" in found._repr_html_()
    one = inspect(robots / "rpr.urdf").closed_forms((2, 2))
    assert (one.entries, one.potential, one.mass_matrix) == ({(2, 2): m2r}, None, None)


@settings(max_examples=8, deadline=None, suppress_health_check=list(HealthCheck))
@given(drawn=arms())
def test_random_arms_equal_pinocchio(drawn, tmp_path_factory):
    """Closed forms of random arms equal Pinocchio.

    The arms have any joint types, tilted and parallel axes, and mimic joints in the chain or on branches.
    """
    path = tmp_path_factory.mktemp("drawn") / "arm.urdf"
    path.write_text(drawn.text)
    arm = make_arm(read_urdf(path), joints=drawn.joints)
    structure = derive(arm)
    rows = read_back(text(formulas(arm, structure)))
    if rows:
        assert_equal_to_pinocchio(arm, rows, tolerance=1e-8)
