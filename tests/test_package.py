"""The package as users install it: a wheel, away from the repository."""

import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

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
