"""What the docs show is what happens: on every page, console and Python blocks run in their order.

In a ```console block a line `$ COMMAND` is followed by what it prints; `pytest --update` writes that anew. ```text
blocks and indented ones are not run: they show long runs, or no commands.
"""

import contextlib
import re
import shlex
import shutil
from pathlib import Path

import pytest
from typer.testing import CliRunner

from spelgen.cli.main import app

ROOT = Path(__file__).parents[1]
PAGES = sorted([ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").glob("*.md")])
FILE = re.compile(r"`((?:[a-z][a-z_]*/)+(?:[a-z][a-z_]*(?:\.[a-z]+)+)?)(?:::\w+)?`")
BLOCK = re.compile(r"^```(console|python)\n(.*?)^```$", re.MULTILINE | re.DOTALL)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_examples(page, tmp_path, monkeypatch, request):
    shutil.copytree(ROOT / "robots", tmp_path / "robots")
    monkeypatch.syspath_prepend(tmp_path)
    text, names = page.read_text(encoding="utf-8"), {"__name__": "example"}
    happened = text
    for language, block in BLOCK.findall(text):
        if language == "console":
            happened = happened.replace(block, run_commands(block, tmp_path))
        else:
            with contextlib.chdir(tmp_path):
                exec(compile(block, str(page), "exec"), names)
    if request.config.getoption("--update"):
        page.write_text(happened, encoding="utf-8")
    else:
        assert text == happened


def run_commands(block: str, folder: Path) -> str:
    """The block as it should be: each command with what it prints."""
    told = []
    for command in re.findall(r"^\$ (.*)$", block, re.MULTILINE):
        program, *arguments = shlex.split(command)
        assert program == "spelgen", f"only spelgen is run here, not: {command}"
        with contextlib.chdir(folder):
            told.append(f"$ {command}\n{CliRunner().invoke(app, arguments, prog_name=program).output}")
    return "\n".join(told)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)#]+)[^)]*\)", page.read_text(encoding="utf-8")):
        assert target.startswith("http") or (page.parent / target).exists(), target


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_files_that_are_named_exist(page):
    for name in FILE.findall(page.read_text(encoding="utf-8")):
        assert any((folder / name).exists() for folder in (ROOT, ROOT / "spelgen")), name
