"""Files of `inspect --formulas` are readable and complete, and names in a URDF cannot inject code into them."""

from __future__ import annotations

import ast
import json
import os
import re
import subprocess
import sys

import pytest
from arms import random_arm
from formula_parsing import assert_equal_to_pinocchio, read_back
from typer.testing import CliRunner

from spelgen.arm.arm import make_arm
from spelgen.arm.configured_arm import load_arm
from spelgen.certificate.formula_files import sympy_source, text, to_dict
from spelgen.certificate.formulas import formulas
from spelgen.certificate.inspection import inspect
from spelgen.cli.main import app
from spelgen.errors import SpelgenError
from spelgen.structure.structure import derive
from spelgen.urdf.read import read_urdf

TWO_LINK = """\
two_link: closed forms for any inertial values

M11 = Izz1R + Izz2 + 2*hx2*cos(q2) - 2*hy2*sin(q2)
M21 = Izz2 + hx2*cos(q2) - hy2*sin(q2)
M22 = Izz2
V = 9.81*hx1R*sin(q1) + 9.81*hx2*sin(q1 + q2) + 9.81*hy1*cos(q1)
    + 9.81*hy2*cos(q1 + q2)

V is determined up to a constant.

Base parameters, and the URDF's values
  Izz1R = Izz1 + m2 [2.25]
  hx1R = hx1 + m2 [1.5]
  hy1 [0]
  Izz2 [1.25]
  hx2 [0.5]
  hy2 [0]

m is the mass [kg], h = m c the first moment [kg m] and I the inertia tensor [kg
m2] about the origin of the joint's frame, turned so that z is the joint's axis,
of all that moves rigidly with the joint: 1 joint1, 2 joint2. q is the joint's
position [rad, m]."""

# expected closed forms, in the notation of a roboticist
ON_A_BOARD = {
    "rpr": {
        "M11": "Ixx3R*(0.5*cos(2*q3) + 0.5) - Ixy3*sin(2*q3) + Izz1R + 2*hz2R*q2 + m2R*q2**2",
        "M32": "0",
        "V": "-9.81*hx3*cos(q3) + 9.81*hy3*sin(q3)",
    },
    "scara": {
        "M22": "Izz2R + Izz4 + 0.55*hx4*cos(q4) - 0.55*hy4*sin(q4) + 0.075625*m3R",
        "M41": "-Izz4 - hx4*(0.275*cos(q4) + 0.325*cos(q2 - q4)) - hy4*(-0.275*sin(q4) + 0.325*sin(q2 - q4))",
    },
    "ur10e": {
        "M54": "-0.5*Ixx6R*sin(q5)*sin(2*q6) - Ixy6*sin(q5)*cos(2*q6) - Ixz6*sin(q6)*cos(q5) "
        "- Iyz6*cos(q5)*cos(q6) - hx6*(0.11985*sin(q5)*cos(q6) - 0.11655*sin(q6)*cos(q5)) "
        "+ hy6*(0.11985*sin(q5)*sin(q6) + 0.11655*cos(q5)*cos(q6)) + (Ixz5 - 0.11985*hx5)*sin(q5) "
        "+ (Iyz5 - 0.11985*hy5R)*cos(q5)",
    },
}


@pytest.fixture
def spelgen(tmp_path, monkeypatch):
    """Return a function that runs a command of spelgen in this process, in an empty folder."""
    monkeypatch.chdir(tmp_path)
    return lambda *arguments: CliRunner().invoke(app, [str(each) for each in arguments])


def test_small_arms_are_shown_completely(robots, spelgen):
    assert spelgen("inspect", robots / "two_link.urdf", "--formulas").stdout == TWO_LINK + "\n"


@pytest.mark.parametrize("robot", ON_A_BOARD)
def test_entries_have_the_notation_of_a_textbook(robots, robot):
    told = inspect(robots / f"{robot}.urdf").closed_forms()
    rows = {row["name"]: row["expression"] for row in to_dict(told)["entries"]}
    assert {name: rows[name] for name in ON_A_BOARD[robot]} == ON_A_BOARD[robot]


def test_large_entries_are_counted_and_shown_on_request(robots, spelgen):
    whole = spelgen("inspect", robots / "ur10e.urdf", "--formulas").stdout
    assert "\nM11: 540 terms, omitted\n" in whole
    assert "--entry 1,1 shows only M11" in " ".join(whole.split())
    assert max(map(len, whole.splitlines())) <= 80
    alone = spelgen("inspect", robots / "ur10e.urdf", "--entry", "1,1").stdout
    assert alone.count("\nM") == 1 and "\nM11 = " in alone
    assert max(map(len, alone.splitlines())) <= 80
    assert_equal_to_pinocchio(load_arm(robots / "ur10e.urdf").chain, read_back(alone))


def test_either_triangle_and_only_the_parameters_in_the_entry(robots, spelgen):
    one, other = (spelgen("inspect", robots / "panda.urdf", "--entry", e).stdout for e in ("2,7", "7,2"))
    assert one == other
    assert_equal_to_pinocchio(load_arm(robots / "panda.urdf").chain, read_back(one))
    assert re.findall(r"^  (\w+) \[", one, re.MULTILINE) == ["Izz7", "Ixz7", "Iyz7", "hx7", "hy7"]


def test_zeros_of_the_inertials_shorten(robots):
    """Zero inertial values shorten closed forms: joint 6 of ur10e turns about its centre of mass, so M65 = 0."""
    told = inspect(robots / "ur10e.urdf", assume="inertials").closed_forms()
    rows = {row["name"]: row["expression"] for row in to_dict(told)["entries"]}
    assert (rows["M62"], rows["M63"], rows["M64"], rows["M65"]) == (*3 * ["Izz6*cos(q5)"], "0")


def test_json_has_the_same_expressions(robots, spelgen):
    data = json.loads(spelgen("inspect", robots / "rpr.urdf", "--formulas", "--format", "json").stdout)
    assert data["schema"] == 1
    assert data["formulas"]["entries"][0] == {
        "name": "M11",
        "row": 1,
        "col": 1,
        "terms": 5,
        "expression": ON_A_BOARD["rpr"]["M11"],
    }
    assert data["formulas"]["base_parameters"][0]["definition"] == "Iyy2 + Iyy3 + Izz1"
    assert "formulas" not in json.loads(spelgen("inspect", robots / "rpr.urdf", "--format", "json").stdout)


def test_without_inertials_there_are_no_values(robots, spelgen, tmp_path):
    bare = re.sub(r"<inertial>.*?</inertial>", "", (robots / "rpr.urdf").read_text(), flags=re.DOTALL)
    (tmp_path / "bare.urdf").write_text(bare)
    told = spelgen("inspect", "bare.urdf", "--formulas").stdout
    assert "Base parameters\n  Izz1R = Iyy2 + Iyy3 + Izz1\n" in told


def test_lines_keep_the_width(shared):
    """Lines have at most 80 characters, even if coefficients have twelve digits and entries begin with long terms."""
    arm = make_arm(read_urdf(shared / "arms" / "kinova_j2n6s300.urdf"))
    told = text(formulas(arm, derive(arm, "inertials")))
    assert re.search(r"\d\.\d{12}\*cos", told)
    assert max(map(len, told.splitlines())) <= 80


# ---- files that are written


@pytest.mark.parametrize(
    ("name", "begins"),
    [
        ("m.py", '"""Closed forms'),
        ("m.json", '{\n  "schema": 1'),
        ("m.txt", "rpr: structure"),
    ],
)
def test_suffix_chooses_the_format(robots, spelgen, tmp_path, name, begins):
    assert spelgen("inspect", robots / "rpr.urdf", "-o", name).stdout == f"wrote {name}\n"
    assert (tmp_path / name).read_text().startswith(begins)


def test_same_bytes_under_any_hash_seed(robots):
    told = set()
    for seed in ("1", "2"):
        command = [
            sys.executable,
            "-m",
            "spelgen",
            "inspect",
            str(robots / "six_dof.urdf"),
            "--format",
            "sympy",
        ]
        environment = os.environ | {"PYTHONHASHSEED": seed, "PYTHONPATH": str(robots.parent)}
        told.add(subprocess.run(command, env=environment, capture_output=True, check=True).stdout)
    assert len(told) == 1


def test_a_long_entry_is_omitted_and_reported():
    arm = random_arm(4, 0)
    source = sympy_source(formulas(arm, derive(arm), longest=100))
    names: dict = {}
    exec(compile(source, "closed_forms.py", "exec"), names)
    assert "# M11: 466 terms, omitted\n# M21: 279 terms" in source
    assert (2, 2) in names["entries"] and (1, 1) not in names["entries"]
    assert "M" not in names


def test_too_large_entries_are_not_expanded():
    """Entries of M with more than 10^5 terms, such as M11 of eight joints, are named but not expanded."""
    arm = random_arm(8, 0)
    found = formulas(arm, derive(arm))
    terms = {formula.name: formula.terms for formula in found.rows}
    assert (terms["M11"], terms["M55"], terms["M88"]) == (None, 466, 1)
    assert "M11: too many terms to be expanded\n" in text(found)


EVIL = {
    # a name that declares the encoding of a Python file, PEP 263
    "rpr": "coding: utf_7&#10;import os; os.mkdir(&quot;taken&quot;)#",
    "joint1": "&quot;&quot;&quot; + open('taken', 'w') #",
    "joint2": "#&quot;&quot;&quot;taken",
    "joint3": "taken&#13;&#8232;&#133;x",
}


def test_hostile_names_are_comments_only(robots, spelgen, tmp_path):
    """Names that contain code or line ends occur only in comments of the written files."""
    urdf = (robots / "rpr.urdf").read_text()
    for name, evil in EVIL.items():
        urdf = urdf.replace(f'"{name}"', f'"{evil}"')
    (tmp_path / "evil.urdf").write_text(urdf)
    outputs = ("out.py", "out.txt")
    for name in outputs:
        result = spelgen("inspect", "evil.urdf", "--formulas", "-o", name)
        assert result.exit_code == 0, result.stderr
    source, told = ((tmp_path / name).read_text(encoding="ascii") for name in outputs)
    assert source.count("taken") == 4
    assert "taken" not in "".join(line for line in source.splitlines() if not line.startswith("#"))
    assert set(re.findall(r"[^ -~]", told)) == {"\n"}
    tree = ast.parse(source)
    texts = [x.value for x in ast.walk(tree) if isinstance(x, ast.Constant) and isinstance(x.value, str)]
    assert all(re.fullmatch(r"[A-Za-z]+\d+R?", each) for each in texts if each != tree.body[0].value.value)
    assert [x.module for x in ast.walk(tree) if isinstance(x, ast.ImportFrom | ast.Import)] == ["sympy"]
    assert not any(line.startswith("#") for line in source.splitlines()[:2])
    subprocess.run([sys.executable, "-I", "out.py"], cwd=tmp_path, check=True)
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([*outputs, "evil.urdf"])


# ---- requests that are refused


def test_entries_that_are_none(robots, spelgen):
    failed = spelgen("inspect", robots / "rpr.urdf", "--entry", "4,1")
    assert failed.exit_code == 1
    assert failed.stderr == "got the entry 4,1 of M, expected a row and a column from 1 to 3, or V\n"
    with pytest.raises(SpelgenError, match="0,1"):
        inspect(robots / "rpr.urdf").closed_forms((0, 1))
    for nonsense in ("x", "1", "1,2,3", "M11", "v"):
        failed = spelgen("inspect", "no.urdf", "--entry", nonsense)
        assert failed.exit_code == 2
        assert "name it as ROW,COLUMN or V" in failed.stderr
