"""Tables of text are the same in every environment, complete and without interpretation of markup."""

import os
import subprocess
import sys

import pytest

from spelgen.listing import WIDTH, Listing, number

NAMES = ("[bold]x[/bold]", "shoulder_pan_joint_of_the_left_arm", "関節1", "a")
TABLE = Listing(
    "Ranges", ("joint", *"abcdef"), tuple((x, *["-0.1 .. 0.3"] * 5, "1") for x in NAMES), "n " * 60
)


def test_columns_are_aligned_and_names_folded_at_their_separators():
    lines = TABLE.text().splitlines()
    cells = "-0.1 .. 0.3  " * 5 + "1"
    assert lines == [
        "Ranges",
        "  joint                 a            b            c            d            e  f",
        f"  [bold]x[/   {cells}",
        "  bold]",
        f"  shoulder_   {cells}",
        "  pan_joint_",
        "  of_the_",
        "  left_arm",
        f"  関節1       {cells}",
        f"  a           {cells}",
        "  " + ("n " * 38).strip(),
        "  " + ("n " * 22).strip(),
    ]
    assert max(map(len, lines)) <= WIDTH


def test_units_of_velocities_are_not_wrapped():
    wide = Listing("", ("", *"abcdef"), (("joint2 [m/s]", *["12345.6789"] * 6), ("j [rad/s]", *["1"] * 6)))
    words = wide.text().split()
    assert "[m/s]" in words and "[rad/s]" in words


def test_numbers_are_never_shortened():
    wide = Listing("", ("joint", *"abcdefghij"), (("x", *["123456789.012"] * 10),))
    assert wide.text().count("123456789.012") == 10


def test_columns_may_be_aligned_to_the_left():
    text = Listing("", ("name", "what"), (("a", "x"), ("b", "yyyyyy")), left=(0, 1)).text()
    assert text.splitlines() == ["  name  what", "  a     x", "  b     yyyyyy"]


@pytest.mark.parametrize("environment", [{"COLUMNS": "20"}, {"FORCE_COLOR": "1", "TERM": "xterm-256color"}])
def test_no_terminal_and_no_environment_changes_it(environment):
    code = "from tests.test_listing import TABLE; import sys; sys.stdout.buffer.write(TABLE.text().encode())"
    found = subprocess.run([sys.executable, "-c", code], env=os.environ | environment, capture_output=True)
    assert found.stdout.decode() == TABLE.text(), found.stderr


def test_html_holds_the_same_and_escapes_it():
    shown = Listing("<t>", ("joint", "q"), (("<script>", "1"),), "a & b").html()
    assert "<script>" not in shown and "&lt;script&gt;" in shown and "a &amp; b" in shown
    assert shown.count("<tr>") == 2 and shown.count('text-align: right">') == 2


def test_three_digits():
    assert [number(x) for x in (None, 0.0, 0.12345, 1e-4, 12345.0)] == [
        "-",
        "0",
        "0.123",
        "1.00e-04",
        "12345",
    ]


def test_counts_keep_all_digits():
    assert [number(x) for x in (0, 52_611, 1_234_567)] == ["0", "52,611", "1,234,567"]


def test_heads_are_folded_only_where_a_part_is_too_wide():
    head = ("", *(f"a head of {k} many words" for k in range(6)))
    folded, whole = Listing("", head, (("name", *["1"] * 6),)).text().split("\n\n")
    assert folded.count("a head of") == 5 and "0 many words" not in folded
    assert whole.splitlines() == ["        a head of 5 many words", "  name                       1"]


def test_a_table_too_wide_for_the_words_of_its_names_is_cut_into_several():
    head = ("", *(f"variant {k}" for k in range(6)))
    rows = (("published: parameters", *["1.80e-05 *"] * 6), ("training step [ms]", *["100.0 *"] * 6))
    text = Listing("Sizes", head, rows, "A note.").text()
    assert max(map(len, text.splitlines())) <= 80
    assert text.count("parameters") == 2 and text.count("training step") == 2
    assert text.count("1.80e-05 *") == 6
    assert all(f"variant {k}" in text for k in range(6))
    assert text.splitlines()[-1] == "  A note."


def test_a_name_is_broken_within_a_word_only_to_avoid_another_table():
    """Names of joints are broken within a word only if the table is then split into fewer parts.

    Here the table has two parts with broken and with whole names, so the names remain whole.
    """
    for cells in (["0.00131"] * 11, ["1.31e-04"] * 12):
        rows = [(name, *cells) for name in ("1 (0.05 s)", "joint_wrist_yaw [rad]")]
        tables = Listing("", ("", *"abcdefghijkl"[: len(cells)]), tuple(rows)).text().split("\n\n")
        assert len(tables) == 2
        assert all("joint_wrist_yaw" in x and all(len(line) <= 80 for line in x.splitlines()) for x in tables)


def test_a_table_with_times_in_its_names_is_at_most_80_characters_wide():
    """The column of names is wide enough for a number with its unit s, such as "0.005 s", which is never wrapped."""
    for width in range(5, 20):
        rows = tuple((name, *[width * "1"] * 9) for name in ("1 step (0.005 s)", "10 steps (0.05 s)"))
        assert max(map(len, Listing("", ("", *"abcdefghi"), rows).text().splitlines())) <= 80
