"""The package passes mypy --strict, as pyproject.toml configures it."""

import subprocess
import sys
from pathlib import Path

import pytest


def test_the_package_passes_mypy():
    pytest.importorskip("mypy")
    command = [sys.executable, "-m", "mypy"]
    done = subprocess.run(command, cwd=Path(__file__).parents[1], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
