"""Emitted text is deterministic, equals its golden copy, passes ruff and contains no code from the URDF."""

import ast
import difflib
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import get_args

import pytest
from emitted import GANTRY, built, import_source

from spelgen.certificate.module_check import check
from spelgen.design import Preset
from spelgen.emission.specify import generate
from spelgen.emission.text import read_spec

ROOT = Path(__file__).parents[1]
GOLDEN = Path(__file__).parent / "golden"
PRESETS = get_args(Preset)
FORMS = pytest.mark.parametrize("standalone", [False, True], ids=["thin", "standalone"])

# mypy follows only those imports from torch that emitted modules use: all of torch would take far longer
MYPY = """[mypy]
strict = True
[mypy-torch.*,numpy.*,sympy.*]
follow_imports = skip
follow_imports_for_stubs = True
[mypy-torch,torch.types,torch._tensor,torch._C.*,torch._ops,torch.nn.*,torch.functional,torch.linalg.*,torch.autograd.*]
follow_imports = normal
"""


@pytest.mark.parametrize(("robot", "preset"), [("two_link", "hybrid"), *(("rpr", p) for p in PRESETS)])
def test_golden_text(robot, preset, request):
    """Thin modules (which import spelgen.runtime) equal their golden copies, which ``pytest --update`` rewrites."""
    path = GOLDEN / f"{robot}_{preset.replace('-', '_')}.py"
    text = built(robot, preset=preset)[0]
    if request.config.getoption("--update"):
        path.write_text(text, encoding="utf-8")
    expected = path.read_text(encoding="utf-8")
    difference = difflib.unified_diff(expected.splitlines(), text.splitlines(), "golden", "now", lineterm="")
    assert text == expected, "\n".join(difference)


def test_a_standalone_module_contains_the_text_of_the_thin_one(tmp_path):
    """Standalone modules contain the arm, model and specification of thin modules, which import spelgen.runtime."""
    for preset in PRESETS:
        thin, standalone = (built("rpr", preset=preset, standalone=x)[0] for x in (False, True))
        arm, model = thin.split("\n\n\nclass Model(")
        rows = arm[arm.index("# Positions [rad, m]") :]
        assert rows in standalone
        assert standalone.endswith(f"\n\n\nclass Model({model}")
        assert "spelgen.runtime" not in standalone


PROGRAM = """from spelgen import generate
for standalone in (False, True):
    print(generate("robots/ur10e.urdf", standalone=standalone))
"""


def test_same_bytes_under_any_hash_seed_and_from_any_folder(tmp_path):
    shutil.copytree(ROOT / "robots", tmp_path / "elsewhere" / "robots")
    texts = set()
    for seed, folder in (("1", ROOT), ("2", tmp_path / "elsewhere")):
        run = subprocess.run(
            [sys.executable, "-c", PROGRAM],
            cwd=folder,
            env={**os.environ, "PYTHONHASHSEED": seed, "PYTHONPATH": str(ROOT)},
            capture_output=True,
            text=True,
            check=True,
        )
        texts.add(run.stdout)
    assert len(texts) == 1


def test_emitted_code_follows_the_rules_of_written_code(tmp_path):
    for robot, preset in [
        *(("rpr", preset) for preset in PRESETS),
        ("panda", "hybrid"),
        ("six_dof", "minimal"),
    ]:
        for form in ("thin", "standalone"):
            text = built(robot, preset=preset, standalone=form == "standalone")[0]
            (tmp_path / f"{robot}_{preset}_{form}.py".replace("-", "_")).write_text(text, encoding="utf-8")
    urdf = tmp_path / "gantry.urdf"
    urdf.write_text(GANTRY, encoding="utf-8")
    (tmp_path / "gantry.py").write_text(generate(urdf), encoding="utf-8")
    (tmp_path / "mypy.ini").write_text(MYPY, encoding="utf-8")
    files = sorted(str(path) for path in tmp_path.glob("*.py"))
    for command in (
        [
            "ruff",
            "check",
            "--isolated",
            "--line-length",
            "110",
            "--select",
            "E,F,I,UP,B,SIM,RUF,D1",
            "--ignore",
            "D10,RUF002",
        ],
        ["ruff", "format", "--isolated", "--line-length", "110", "--check"],
        ["mypy", "--config-file", "mypy.ini", "--no-incremental", "--cache-dir", "cache"],
    ):
        run = subprocess.run(
            [sys.executable, "-m", *command, *files],
            cwd=tmp_path,
            capture_output=True,
            text=True,
            check=False,
        )
        assert run.returncode == 0, run.stdout + run.stderr


HOSTILE = [
    '"""; import os; os.system("true") #',
    "{{ 7 * 7 }}{% raw %}",
    "class",
    "a\\",
    "../../etc",
    "Schulter\u00fc\u4e2d",
    "joint 1",
    "joint-1",
]


@FORMS
def test_no_text_of_the_urdf_becomes_code(tmp_path, standalone):
    """Names in a URDF cannot become code: hostile names change only string constants of the module's syntax tree."""
    from xml.sax.saxutils import quoteattr

    def written(robot, names, file):
        links = "".join(f'<link name="l{k}"/>' for k in range(len(names) + 1))
        joints = "".join(
            f'<joint name={quoteattr(name)} type="continuous"><parent link="l{k}"/><child link="l{k + 1}"/>'
            f'<origin xyz="0.1 0 0.2" rpy="{k % 2} 0 0"/><axis xyz="0 0 1"/></joint>'
            for k, name in enumerate(names)
        )
        urdf = tmp_path / f"{file}.urdf"
        urdf.write_text(f"<robot name={quoteattr(robot)}>{links}{joints}</robot>", encoding="utf-8")
        return generate(urdf, standalone=standalone)

    text = written(HOSTILE[0], HOSTILE, "hostile")
    plain = written("plain", [f"joint{k}" for k in range(len(HOSTILE))], "plain")
    shapes = []
    for source in (text, plain):
        tree = ast.parse(source)
        for node in ast.walk(tree):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                node.value = ""
        shapes.append(ast.dump(tree))
    assert shapes[0] == shapes[1]
    path = tmp_path / "hostile_spel.py"
    model = import_source(text, path).Model()
    assert model.joint_names == tuple(HOSTILE)
    assert read_spec(path).joint_names == tuple(HOSTILE)
    assert read_spec(path).robot == HOSTILE[0]


def test_check_detects_a_changed_urdf(tmp_path):
    urdf = tmp_path / "rpr.urdf"
    shutil.copy(ROOT / "robots" / "rpr.urdf", urdf)
    shutil.copy(ROOT / "robots" / "rpr.yaml", tmp_path)
    module = tmp_path / "rpr_spel.py"
    module.write_text(generate(urdf), encoding="utf-8")
    fresh = check(module)
    assert fresh.fresh
    assert len(fresh.proof.checks) > 5
    urdf.write_text(urdf.read_text().replace("0.0203", "0.0204"))
    changed = check(module)
    assert not changed.fresh
    assert f"{urdf} has changed since the module was built" in changed.reasons
    shutil.copy(ROOT / "robots" / "rpr.urdf", urdf)
    module.write_text(module.read_text() + "\n# edited\n", encoding="utf-8")
    assert check(module).reasons == ("the text of the module differs from that of `spelgen build`",)
