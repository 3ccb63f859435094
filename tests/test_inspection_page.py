"""The structure page is complete, self-contained HTML for all names that a URDF can have."""

import re

import pytest
from html_page import Page
from typer.testing import CliRunner

from spelgen.arm.configured_arm import load_arm
from spelgen.certificate.inspection import inspect
from spelgen.certificate.verify import verify
from spelgen.cli.main import app
from spelgen.render.arm_pages import inspection_page

HOSTILE = "<script>alert(1)</script>{{ 7 * 7 }}&quot;'&amp;"


@pytest.mark.parametrize("robot", ["two_link", "rpr", "panda"])
def test_the_page_states_the_same_as_the_text(robots, robot):
    found = inspect(robots / f"{robot}.urdf")
    shown = Page(inspection_page(found))
    told = " ".join(" ".join(shown.text).split())
    for sentence in (*found.needs().values(), *map(str, found.facts)):
        assert sentence in told
    cells = re.findall(r'<td class="(\w+)" data-row="(\d)" data-column="(\d)"', inspection_page(found))
    kinds = {(e.row + 1, e.column + 1): e.kind for e in found.structure.entries}
    assert len(cells) == len(found.structure.joints) ** 2
    assert all(kinds[max(int(i), int(j)) + 1, min(int(i), int(j)) + 1] == kind for kind, i, j in cells)
    assert shown.links == ["data:,", "#top"]


def test_formulas_and_proof_only_on_request(robots, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run = CliRunner().invoke(
        app, ["inspect", str(robots / "rpr.urdf"), "--formulas", "--verify", "-o", "rpr.html"]
    )
    assert run.exit_code == 0, run.stderr
    text = " ".join(Page((tmp_path / "rpr.html").read_text()).text)
    assert "\nM22 = m2R\n" in text
    found, arm = inspect(robots / "rpr.urdf"), load_arm(robots / "rpr.urdf")
    assert verify(arm.robot, arm.chain, found.structure).checks[0].found in text
    plain = inspection_page(found)
    assert "Closed forms" not in plain and "Proof" not in plain


def test_names_are_escaped(robots, tmp_path):
    text = (
        (robots / "rpr.urdf").read_text().replace('"rpr"', f'"{HOSTILE}"').replace('"joint3"', f'"{HOSTILE}"')
    )
    (tmp_path / "evil.urdf").write_text(text.replace(HOSTILE, HOSTILE.replace("<", "&lt;")))
    found = inspect(tmp_path / "evil.urdf")
    shown = Page(inspection_page(found, found.closed_forms(), urdf=tmp_path / "evil.urdf"))
    assert "".join(shown.text).count("<script>alert(1)</script>{{ 7 * 7 }}\"'&") >= 3
