"""What the docs show is what happens: every console block is run and compared, every Python block executed.

In a ```console block a line `$ COMMAND` is followed by what it prints. ```text blocks and indented ones are not run: they
show long runs, or are no commands.
"""

import contextlib
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGES = sorted([ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").glob("*.md")])


def blocks(page: Path, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Where the examples run: a folder with the project's robots in it."""
    path = tmp_path_factory.mktemp("docs")
    shutil.copytree(ROOT / "robots", path / "robots")
    return path


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_console_examples(page, folder):
    for block in blocks(page, "console"):
        for example in re.split(r"^\$ ", block, flags=re.MULTILINE)[1:]:
            command, _, expected = example.partition("\n")
            program, *arguments = shlex.split(command)
            assert program == "spelgen", f"only spelgen is run here: {command}"
            done = subprocess.run(
                [sys.executable, "-m", "spelgen", *arguments],
                cwd=folder, env={"PYTHONPATH": str(ROOT)}, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
                check=False,
            )  # fmt: skip
            assert done.stdout.strip() == expected.strip(), command


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_python_examples(page, folder):
    names = {"__name__": "example"}
    with contextlib.chdir(folder):
        for block in blocks(page, "python"):
            exec(compile(block, str(page), "exec"), names)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)#]+)[^)]*\)", page.read_text(encoding="utf-8")):
        if not target.startswith("http"):
            assert (page.parent / target).exists(), target
