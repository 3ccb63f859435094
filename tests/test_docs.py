"""Console and Python blocks of each documentation page run in order and print the outputs on the page.

In a ```console block, a line `$ COMMAND` is followed by its output. The output of a Python block is in the ```output
block after it. `pytest --update` rewrites both outputs. ```text blocks and indented code blocks are not run: they show
commands that take long, or no commands. Each tutorial is also a notebook with the same cells.
"""

import ast
import contextlib
import io
import json
import re
import shlex
import shutil
import sys
from collections import Counter
from pathlib import Path
from typing import get_args

import pytest
import settings_page
from typer.main import get_command
from typer.testing import CliRunner

from spelgen.cli.main import app
from spelgen.fitting.run_folder import RunFolder
from spelgen.settings.log_mapping import Accepted

ROOT = Path(__file__).parents[1]
PAGES = sorted([ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").glob("*.md")])
FILE = re.compile(r"`((?:[a-z][a-z_]*/)+(?:[a-z][a-z_]*(?:\.[a-z]+)+)?)(?:::\w+)?`")
BLOCK = re.compile(r"^```(console|python)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
CELL = re.compile(r"^```python\n(.*?)^```\n(?:\n```output\n(.*?)^```\n)?", re.MULTILINE | re.DOTALL)
HISTORY = re.compile(
    r"\b(?:formerly|the former (?:fit|version|code|release|graph)|previously|no longer|used to|until release"
    r"|earlier release|not taken|was tried)\b",
    re.IGNORECASE,
)
SLOW = {"tutorial_servo.md"}  # a fit takes half a minute: only `pytest --update` runs the page
# replacements in the code of pages, to shorten their runs: fewer rows of a table, shorter motions, longer steps
SHORTER = {
    "control.md": {
        '("estimator", "learned", "URDF"):': '("estimator", "learned"):',
        "PICKED, END = 3.0, 11.0": "PICKED, END = 2.0, 6.5",
        "substeps=8": "substeps=3",
        "END, dynamics=with_load": "END if estimator else 4.5, dynamics=with_load",
    },
}
RUN = [page for page in PAGES if page.name not in SLOW or "--update" in sys.argv]
TUTORIALS = sorted((ROOT / "docs").glob("tutorial_*.md"))


@pytest.mark.parametrize("page", RUN, ids=lambda page: page.name)
def test_examples(page, tmp_path, monkeypatch, request):
    shutil.copytree(ROOT / "robots", tmp_path / "robots")
    if page in TUTORIALS:  # the working folder is docs/, as for a notebook that is opened there
        shutil.copytree(ROOT / "docs", tmp_path / "docs")
    folder = tmp_path / "docs" if page in TUTORIALS else tmp_path
    files = tree(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    text, names = page.read_text(encoding="utf-8"), {"__name__": "example"}
    update = request.config.getoption("--update")
    for full, shorter in SHORTER.get(page.name, {}).items():
        assert full in text
        text = text if update else text.replace(full, shorter)
    happened = text
    for language, block in BLOCK.findall(text):
        if language == "console":
            happened = happened.replace(block, run_commands(block, folder))
        else:
            printed = io.StringIO()
            with contextlib.chdir(folder), contextlib.redirect_stdout(printed):
                exec(compile(block, str(page), "exec"), names)
            if page in TUTORIALS:
                happened = happened.replace(cell(text, block), cell("", block, printed.getvalue()))
    if page in TUTORIALS:
        assert tree(tmp_path) == files
    if update:
        page.write_text(happened, encoding="utf-8")
    else:
        assert text == happened


def tree(folder: Path) -> dict[Path, bytes]:
    """Return the contents of the files in a folder, by path."""
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def cell(text: str, block: str, output: str = "") -> str:
    """Return the Markdown of a tutorial's cell: the Python code `block`, and the ```output block after it.

    The output is copied from `text`, the Markdown of the page, if `text` contains the block. Otherwise it is `output`.
    """
    for match in CELL.finditer(text):
        if match[1] == block:
            return match[0]
    return f"```python\n{block}```\n" + (f"\n```output\n{output}```\n" if output else "")


def notebook(page: Path) -> str:
    """Return the notebook of a page: prose as Markdown cells, blocks with their outputs as code cells."""
    text, cells, end = page.read_text(encoding="utf-8"), [], 0
    for match in CELL.finditer(text):
        cells.append({"cell_type": "markdown", "source": text[end : match.start()].strip()})
        output = {"output_type": "stream", "name": "stdout", "text": match[2]}
        outputs = [output] if match[2] else []
        code = {"cell_type": "code", "execution_count": len(cells), "outputs": outputs}
        cells.append(code | {"source": match[1].rstrip("\n")})
        end = match.end()
    cells.append({"cell_type": "markdown", "source": text[end:].strip()})
    cells = [{"id": f"cell-{k}", "metadata": {}} | x for k, x in enumerate(cells) if x["source"]]
    kernel = {"kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"}}
    book = {"cells": cells, "metadata": kernel, "nbformat": 4, "nbformat_minor": 5}
    return json.dumps(book, indent=1, sort_keys=True) + "\n"


@pytest.mark.parametrize("page", TUTORIALS, ids=lambda page: page.name)
def test_tutorials_are_notebooks(page, request):
    path = page.with_suffix(".ipynb")
    if request.config.getoption("--update"):
        path.write_text(notebook(page), encoding="utf-8")
    assert path.read_text(encoding="utf-8") == notebook(page)


@pytest.mark.parametrize("path", settings_page.PAGES, ids=lambda path: path.name)
def test_the_tables_of_settings_are_up_to_date(path, request):
    """The pages of settings have every key with its values, default, unit and meaning."""
    if request.config.getoption("--update"):
        path.write_text(settings_page.page(path), encoding="utf-8")
    assert path.read_text(encoding="utf-8") == settings_page.page(path)


def run_commands(block: str, folder: Path) -> str:
    """Run the commands of a console block; return the block with the actual output of each command."""
    told = []
    for command in re.findall(r"^\$ (.*)$", block, re.MULTILINE):
        program, *arguments = shlex.split(command)
        assert program == "spelgen", f"only spelgen is run here, not: {command}"
        with contextlib.chdir(folder):
            told.append(f"$ {command}\n{CliRunner().invoke(app, arguments, prog_name=program).output}")
    return "\n".join(told)


def anchors(page: Path) -> set[str]:
    """Return the anchors of a page's headings; for headings of plain words, MkDocs and GitHub make the same anchors."""
    headings = re.findall(r"^#+ (.*)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"\s+", "-", re.sub(r"[^\w\s-]", "", heading.lower())) for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page):
    text = page.read_text(encoding="utf-8")
    for target, anchor in re.findall(r"\]\(([^)#]*)#?([^)]*)\)", text):
        if target.startswith("http"):
            continue
        linked = page.parent / target if target else page
        assert linked.exists(), target
        assert not anchor or anchor in anchors(linked), f"{target}#{anchor}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_a_page_is_short_and_has_no_history(page):
    """A page has at most 2,500 words, and only docs/decisions.md describes former versions and trials."""
    text = page.read_text(encoding="utf-8")
    assert len(text.split()) <= 2500
    if page.name != "decisions.md":
        assert HISTORY.findall(text) == []


def test_the_changelog_of_a_version_is_short():
    for section in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8").split("\n## ")[1:]:
        assert len(section.splitlines()) <= 40, section.splitlines()[0]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_files_that_are_named_exist(page):
    for name in FILE.findall(page.read_text(encoding="utf-8")):
        assert any((folder / name).exists() for folder in (ROOT, ROOT / "spelgen")), name


# position of the code among the arguments of functions that make messages
CODE_ARGUMENTS = {"Diagnostic": 1, "warn": 1, "Check": 0, "_warning": 0, "_note": 0, "_remark": 0}


def codes_of_messages() -> set[str]:
    """Return the codes of remarks, warnings and errors that --accept can allow, collected from the package's source."""
    constants: dict[str, ast.expr] = {}
    codes = set(get_args(Accepted))
    for path in sorted((ROOT / "spelgen").rglob("*.py")):
        found, nodes = [], list(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))
        for target, value in ((x.targets[0], x.value) for x in nodes if isinstance(x, ast.Assign)):
            parallel = isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple)
            for name, x in zip(target.elts, value.elts, strict=True) if parallel else [(target, value)]:
                constants[getattr(name, "id", "")] = x
                if getattr(name, "id", "") in ("code", "SEEN", "ELASTIC", "WARNINGS"):
                    found += getattr(x, "elts", [x])
        for node in nodes:
            if isinstance(node, ast.Call):
                place = CODE_ARGUMENTS.get(getattr(node.func, "attr", getattr(node.func, "id", "")))
                found += [] if place is None else node.args[place : place + 1]
            elif isinstance(node, ast.Yield) and len(getattr(node.value, "elts", ())) == 4:
                found += node.value.elts[:1]  # codes of findings of spelgen/urdf/lint.py
        resolved = [constants.get(x.id, x) if isinstance(x, ast.Name) else x for x in found]
        codes |= {x.value for x in resolved if isinstance(x, ast.Constant) and isinstance(x.value, str)}
    return codes


def test_every_code_is_explained_once():
    """Each code of a message has one row in docs/messages.md, and each code on this page exists."""
    page = (ROOT / "docs" / "messages.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| (`[^|]*) \|", page, re.MULTILINE)
    explained = Counter(code for row in rows for code in re.findall(r"`([a-z-]+)`", row))
    assert explained == Counter(dict.fromkeys(codes_of_messages(), 1))


def test_every_file_of_a_run_folder_is_explained():
    """Each file of a run folder has a row in docs/cli_runs.md."""
    page = (ROOT / "docs" / "cli_runs.md").read_text(encoding="utf-8")
    files = [path.name for path in vars(RunFolder("run")).values() if path.name != "run"]
    assert [name for name in files if not re.search(rf"^\\|.*`{re.escape(name)}`.*\\|", page, re.M)] == []


def test_every_option_is_explained():
    """Each command has a section in docs/cli.md or docs/cli_runs.md, and each of its options is on a page."""
    pages = "".join(page.read_text(encoding="utf-8") for page in PAGES)
    for name, command in get_command(app).commands.items():
        assert f"\n## {name}\n" in pages
        for option in (x for parameter in command.params for x in parameter.opts if x.startswith("--")):
            assert re.search(rf"{option}\b", pages), f"{name} {option}"
