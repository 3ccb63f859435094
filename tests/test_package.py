"""The package as users install it: a wheel, away from the repository."""

import os
import pkgutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

import spelgen
from spelgen import pipeline

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def installed(tmp_path_factory) -> Path:
    """The unpacked wheel."""
    pytest.importorskip("hatchling", reason="building the wheel needs hatchling")
    folder = tmp_path_factory.mktemp("wheel")
    command = ["-m", "pip", "wheel", "-qq", "--no-deps", "--no-build-isolation", "-w", str(folder), str(ROOT)]
    subprocess.run([sys.executable, *command], check=True)
    (wheel,) = folder.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(folder / "site")
    return folder / "site"


def test_wheel_holds_all_that_the_package_needs(installed):
    files = {str(path.relative_to(installed)) for path in installed.rglob("*") if path.is_file()}
    source = [path for path in (ROOT / "spelgen").rglob("*") if path.is_file() and path.suffix != ".pyc"]
    assert {str(path.relative_to(ROOT)) for path in source} <= files
    templates = [path for path in (ROOT / "templates").rglob("*") if path.is_file()]
    assert {f"spelgen/{path.relative_to(ROOT)}" for path in templates} <= files
    assert {name.split("/")[0] for name in files if ".dist-info" not in name} == {"spelgen"}


def test_installed_command_builds_the_same_module(installed, robots, tmp_path):
    command = [sys.executable, "-m", "spelgen", "build", str(robots / "rpr.urdf"), "-o", "module.py"]
    subprocess.run(command, cwd=tmp_path, env=os.environ | {"PYTHONPATH": str(installed)}, check=True)
    assert (tmp_path / "module.py").read_text(encoding="utf-8") == pipeline.generate(robots / "rpr.urdf")


def test_every_name_of_the_api_is_there():
    assert sorted([*spelgen._HOME, "__version__"]) == sorted(spelgen.__all__) == dir(spelgen)
    rooms = {module.name for module in pkgutil.iter_modules(spelgen.__path__)}
    assert not rooms & set(spelgen.__all__), "a room of that name would take its place once it is imported"
    for name, home in spelgen._HOME.items():
        assert getattr(spelgen, name).__module__ == f"spelgen.{home}"
    with pytest.raises(AttributeError, match="no attribute 'train'"):
        spelgen.train  # noqa: B018


def test_importing_it_imports_nothing_heavy():
    code = "import sys, spelgen; print({'numpy', 'torch', 'pydantic', 'lxml'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "set()\n"


def test_objects_are_short_to_read(robots):
    arm = spelgen.load_arm(robots / "rpr.urdf")
    assert repr(arm) == "<LoadedArm 'rpr': 3 joints of rpr.urdf>"
    told = "3 outputs, 2 constants, 11 base parameters"
    assert repr(arm.structure) == f"<Structure of 3 joints (kinematics trusted): {told}>"
    told = "3 outputs and 2 constants, 11 base inertial parameters"
    assert repr(arm.inspect()) == f"<Inspection of 'rpr': {told}>"
    for each in (arm, arm.inspect(), arm.verify(), arm.formulas((2, 2))):
        assert len(repr(each)) < 100
        assert each._repr_html_().count("<tr>") >= 2
