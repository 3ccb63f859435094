"""Pages in a headless browser: no console messages, no requests, no overflow, usable by keyboard."""

from __future__ import annotations

import pytest
from chromium import Chromium, executable
from test_report import run  # noqa: F401  (a fixture)

from spelgen.arm.configured_arm import load_arm
from spelgen.certificate.inspection import inspect
from spelgen.render.arm_pages import inspection_page
from spelgen.render.report_page import write_report

pytestmark = pytest.mark.skipif(executable() is None, reason="no Chromium is installed")
ACTIVE = "document.activeElement"
EXTENT = """(() => {
  const canvas = document.querySelector("canvas.arm"), pen = CanvasRenderingContext2D.prototype;
  const { beginPath, lineTo, fill } = pen;
  let path = [], corners = [];
  pen.beginPath = function () { path = []; beginPath.call(this); };
  pen.lineTo = function (x, y) {
    path.push([x / canvas.clientWidth, y / canvas.clientHeight]);
    lineTo.call(this, x, y);
  };
  pen.fill = function () { corners.push(...path); fill.call(this); };
  window.dispatchEvent(new Event("resize"));
  Object.assign(pen, { beginPath, lineTo, fill });
  return [0, 1].flatMap((k) => [Math.min, Math.max].map((end) => end(...corners.map((corner) => corner[k]))));
})()"""
"""Left, right, upper and lower end of the faces that the arm is drawn of, by the size of its frame."""


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    found = Chromium(tmp_path_factory.mktemp("profile"))
    yield found
    found.close()


@pytest.fixture
def pages(run, robots, tmp_path):  # noqa: F811
    """Return the pages under test: the report of a run with its URDF, and the page of `inspect` for the Panda."""
    (run / "robot.urdf").write_bytes((robots / "rpr.urdf").read_bytes())
    panda = load_arm(robots / "panda.urdf")
    (tmp_path / "panda.html").write_text(
        inspection_page(inspect(panda), urdf=panda.robot.path), encoding="utf-8"
    )
    return [write_report(run), tmp_path / "panda.html"]


@pytest.mark.parametrize("width", [400, 1400])
@pytest.mark.parametrize("dark", [False, True])
def test_pages_have_no_console_messages_requests_or_overflow(browser, pages, width, dark):
    for path in pages:
        browser.open(path, width=width, dark=dark)
        assert browser.run("document.documentElement.scrollWidth") <= width, path
        assert browser.run("document.querySelector('canvas.arm').width") > 0
        # at the width of a phone, tables of results are lists, none of which is scrolled sideways
        wide = "[...document.querySelectorAll('.wide:has(td[data-head])')]"
        assert path != pages[0] or browser.run(f"{wide}.length") > 0
        overflow = browser.run(f"Math.max(0, ...{wide}.map(x => x.scrollWidth - x.clientWidth))")
        assert width > 400 or overflow == 0
        assert browser.problems == []
        assert [url for url in browser.requests if not url.startswith("data:")] == [path.as_uri()]


def test_titles_and_numbers_of_tables_are_not_broken_on_a_phone(browser, pages):
    """On a narrow screen, a table is shown as a list of labels and numbers. Its title is as wide as the table.

    A number stays on one line, also with a long label (the name of its column).
    """
    browser.open(pages[0], width=400)
    cells = "[...document.querySelectorAll('td.n[data-head]')]"
    browser.run(f"{cells}.forEach(x => (x.dataset.head = 'least squares with memory + observer'))")
    browser.run(f"{cells}.forEach(x => (x.textContent = '2.32e-04'))")
    rows = "(x => (range => (range.selectNodeContents(x), range.getClientRects().length))(document.createRange()))"
    assert browser.run(f"Math.max(...{cells}.map({rows}))") == 1
    captions = "[...document.querySelectorAll('table:has(td[data-head]) caption')]"
    assert browser.run(f"Math.min(...{captions}.map(x => x.offsetWidth / x.parentNode.offsetWidth))") > 0.9


def test_no_predictor_is_hidden_on_a_tablet(browser, pages):
    """At 900 pixels, tables with a column per predictor have no column beyond the page, also with long names."""
    browser.open(pages[0], width=900)
    tables = "[...document.querySelectorAll('.tables .wide')]"
    browser.run(
        f"{tables}.forEach(x => x.querySelectorAll('tbody th').forEach(y => y.append('_of_the_arm [rad]')))"
    )
    browser.run(
        "document.querySelectorAll('.tables td.n, .tables thead th.n').forEach("
        "x => (x.textContent = x.matches('td') ? '2.32e-04' : 'least squares with memory'))"
    )
    assert browser.run(f"Math.max(...{tables}.map(x => x.scrollWidth - x.clientWidth))") == 0


def test_the_arm_is_printed_and_reported_missing_without_scripts(browser, pages):
    shown = (
        "['.without-script', 'canvas.arm', '.controls']"
        ".map(x => getComputedStyle(document.querySelector(x)).display)"
    )
    browser.open(pages[0])
    assert browser.run(shown) == ["none", "block", "flex"]
    browser.open(pages[0], media="print")
    assert browser.run(shown) == ["none", "block", "none"]
    plain = pages[0].with_name("plain.html")
    text = pages[0].read_text(encoding="utf-8")
    plain.write_text(text.replace("script-src 'sha256", "script-src 'sha512"), encoding="utf-8")
    # The content security policy allows only scripts with the stated digest, which is now wrong: no script runs.
    browser.open(plain)
    assert browser.run(shown) == ["block", "none", "none"]


def test_the_policy_lets_nothing_else_run_or_load(browser, pages):
    path = pages[0].with_name("attacked.html")
    attack = "<script>window.attacked = 1</script><img src='http://127.0.0.1:9/x.png' onerror='window.attacked = 2'>"
    text = pages[0].read_text(encoding="utf-8")
    path.write_text(text.replace("</main>", attack + "</main>"), encoding="utf-8")
    browser.open(path)
    assert browser.run("window.attacked === undefined")
    assert len(browser.problems) >= 2
    assert browser.run("document.querySelector('canvas.arm').width") > 0


def test_keys_lead_through_the_mass_matrix_and_light_its_joints(browser, pages):
    browser.open(pages[0])
    browser.run("document.querySelector('.matrix td').focus()")
    told = "document.getElementById('entry').textContent"
    assert browser.run(told).startswith("M11 depends on joints 2,3 only.")
    before = browser.run("document.querySelector('canvas.arm').toDataURL()")
    for key, code in (("ArrowDown", 40), ("ArrowRight", 39)):
        browser.press(key, code)
    assert browser.run(told).startswith("M22 is constant.")
    assert browser.run(f"{ACTIVE}.classList.contains('lit') && {ACTIVE}.tabIndex === 0")
    assert browser.run("document.querySelector('canvas.arm').toDataURL()") != before


def test_the_arm_fills_its_frame(browser, pages):
    for path in pages:
        browser.open(path)
        left, right, top, bottom = browser.run(EXTENT)
        assert 0.0 < left < right < 1.0 and 0.0 < top < bottom < 1.0
        # The frame has room for the whole motion; the arm at its current position extends over more than 30 % of the
        # width or height.
        assert max(right - left, bottom - top) > 0.3


def test_keys_turn_the_arm_and_play_its_motion(browser, pages):
    browser.open(pages[0])
    picture = "document.querySelector('canvas.arm').toDataURL()"
    before = browser.run(picture)
    browser.run("document.querySelector('canvas.arm').focus()")
    browser.press("ArrowLeft", 37)
    assert browser.run(picture) != before
    state = "document.getElementById('arm-play').getAttribute('aria-pressed')"
    browser.press(" ", 32, " ")
    assert browser.run(state) == "true"
    browser.press(" ", 32, " ")
    assert browser.run(state) == "false"
    moved = "document.querySelectorAll('svg.chart[data-motion=\"prediction typical\"] .cursor').length"
    assert browser.run(moved) == 12


def test_everything_that_can_be_used_has_a_name(browser, pages):
    unnamed = """[...document.querySelectorAll('button, select, input, canvas, a, [tabindex], svg[role]')]
        .filter(x => !(x.getAttribute('aria-label') || x.textContent.trim())).map(x => x.outerHTML.slice(0, 80))"""
    for path in pages:
        browser.open(path)
        assert browser.run(unnamed) == []
        assert browser.run("document.querySelectorAll('h1').length") == 1
