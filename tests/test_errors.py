"""Errors and diagnostics state file, line, element, the value found, the value expected, and advice."""

import json
import pickle
from pathlib import Path

import pytest

from spelgen.errors import (
    Diagnostic,
    LogError,
    OptionError,
    RunError,
    SpelgenError,
    SpelgenErrors,
    UrdfError,
    collect,
    suggestion,
)


@pytest.mark.parametrize(
    ("error", "text"),
    [
        (SpelgenError("no such file"), "no such file"),
        (SpelgenError("no such file", file="a.urdf"), "a.urdf: no such file"),
        (SpelgenError("2", expected="3"), "got 2, expected 3"),
        (
            SpelgenError("no joint is named 'a'", do="did you mean 'b'?"),
            "no joint is named 'a'; did you mean 'b'?",
        ),
        (
            UrdfError(
                "4 numbers", file="a.urdf", line=7, element="joint 'a'", expected="three", do="remove one"
            ),
            "a.urdf:7: joint 'a': got 4 numbers, expected three; remove one",
        ),
        (
            UrdfError("no name", line=7, element="<link>", expected="a name"),
            "7: <link>: got no name, expected a name",
        ),
    ],
)
def test_an_error_omits_unknown_fields(error, text):
    assert str(error) == text


def test_collect_raises_nothing_one_or_all():
    first, second = UrdfError("first", file="a"), UrdfError("second", file="b")
    collect([])
    with pytest.raises(UrdfError) as one:
        collect([first])
    assert one.value is first
    with pytest.raises(SpelgenErrors) as all_:
        collect([first, second])
    assert str(all_.value) == "a: first\nb: second"
    assert all_.value.errors == (first, second)
    many = SpelgenErrors([SpelgenError("first", file="a", line=k) for k in range(60)])
    assert str(many).splitlines()[49:] == ["a:49: first", "and 10 more like these"]


def test_suggestion_is_the_nearest_name_or_the_first_ten():
    assert suggestion("jiont_1", ["joint_1", "base"]) == "did you mean 'joint_1'?"
    assert suggestion("x", ["alpha", "beta"]) == "known are 'alpha', 'beta'"
    assert suggestion("x", [f"joint{i}" for i in range(12)]).endswith("'joint9' and 2 more")


def test_a_diagnostic_is_the_public_json_object():
    diagnostic = Diagnostic("info", "snapped-angle", "joint 'a2' origin", 41, "1.5708 is taken as pi/2")
    assert json.dumps(diagnostic.to_dict()) == (
        '{"severity": "info", "code": "snapped-angle", "where": "joint \'a2\' origin", "line": 41, '
        '"message": "1.5708 is taken as pi/2"}'
    )


def test_an_error_of_several_files_is_reported_once():
    """Equal errors of several files are one message that lists the files."""
    lacking = [LogError("3 columns", file=f"{k}.csv", expected="4") for k in range(9)]
    told = str(SpelgenErrors([*lacking, LogError("another", file="0.csv")]))
    assert told.splitlines() == [
        "0.csv: got 3 columns, expected 4",
        "  the same: 1.csv, 2.csv, 3.csv, 4.csv, 5.csv, and 3 more",
        "0.csv: another",
    ]


@pytest.mark.parametrize(
    "error",
    [
        LogError("a gap", file=Path("a.csv"), line=3, expected="none", do="cut the log"),
        OptionError("patience", "belongs to the objective rollout"),
        SpelgenErrors([LogError("a gap", file="a.csv"), RunError("no run")]),
    ],
    ids=lambda error: type(error).__name__,
)
def test_a_copy_of_an_error_is_the_same_error(error):
    """An error has the same type and text after pickling, by which Ray copies the errors of its workers."""
    copied = pickle.loads(pickle.dumps(error))
    assert (type(copied), str(copied)) == (type(error), str(error))
