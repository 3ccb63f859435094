"""The documentation site lists each page, resolves each API name and builds."""

import importlib
import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parents[1]
PAGES = sorted((ROOT / "docs").glob("*.md"))
SITE = yaml.safe_load((ROOT / "mkdocs.yml").read_text(encoding="utf-8"))


def places(entries):
    """Return the files of the navigation of the site, at any depth."""
    if isinstance(entries, str):
        return [entries]
    return [x for each in entries for x in places(each.values() if isinstance(each, dict) else each)]


def test_every_page_has_one_place():
    assert sorted(places(SITE["nav"])) == [page.name for page in PAGES]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_documented_name_exists(page):
    for name in re.findall(r"^::: (\S+)$", page.read_text(encoding="utf-8"), re.MULTILINE):
        module, member = name.rsplit(".", 1)
        assert getattr(importlib.import_module(module), member).__doc__, name


def test_every_name_of_the_api_is_written_out():
    import spelgen

    told = re.findall(
        r"^::: spelgen\.(\w+)$", (ROOT / "docs/api.md").read_text(encoding="utf-8"), re.MULTILINE
    )
    assert sorted(told) == sorted(set(spelgen.__all__) - {"__version__"})


@pytest.mark.skipif(importlib.util.find_spec("mkdocs") is None, reason="mkdocs is not installed")
def test_the_site_builds_without_a_warning(tmp_path):
    built = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "-d", str(tmp_path / "site")],
        cwd=ROOT,
        env=os.environ | {"NO_MKDOCS_2_WARNING": "1", "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert built.returncode == 0, built.stderr
    page = (tmp_path / "site/api/index.html").read_text(encoding="utf-8")
    assert "doc-signature" in page and "https://fonts" not in page
