"""Texts for users are plain technical English; counts of unclear constructions in docstrings and comments only fall."""

import ast
import inspect
import re
from pathlib import Path

import pytest
import words

import spelgen

ROOT = Path(__file__).parents[1]
UNUSED = re.compile(
    r"\b(ask(s|ed|ing)?|tell(s|ing)?|told|believ(e|es|ed|ing)|belief|trust(s|ed)?|hold(s|ing)?|held|worth|nobody|odd"
    r"|leav(e|es|ing)|enter(s|ed|ing)?|rests?|hopeless|hardly|forgets?|to be found)\b",
    re.IGNORECASE,
)
FRAGMENT = re.compile(r"^(What|Of|By|Whoever|Whether) ")
# allowed uses: terms of mechanics, the name of an option, and a cell of tables of results
ALLOWED = re.compile(
    r"\b(at|from|to) rest\b|\|rest\||--trust|trust=True|`trust`|hold(s|ing)? the arm|leaves? out|held samples"
    r"|zero-order hold"
)
CODE = re.compile(r"^```.*?^```$|^(?: {4}|\t)[^\n]*$|`[^`\n]*`|\]\([^)]*\)", re.MULTILINE | re.DOTALL)
# packages whose strings are not texts for users
INTERNAL = ("runtime",)


def wrong(text: str) -> list[str]:
    plain = ALLOWED.sub("", text)
    return [match.group() for match in (*UNUSED.finditer(plain), *FRAGMENT.finditer(plain))]


def documented(tree: ast.Module) -> set[ast.AST]:
    """Return all constants of a syntax tree that are statements: docstrings, including strings after assignments."""
    return {x.value for x in ast.walk(tree) if isinstance(x, ast.Expr) and isinstance(x.value, ast.Constant)}


def messages(path: Path) -> list[str]:
    """Return the strings of several words in the code of a file; values in f-strings are replaced by "_"."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    skipped = documented(tree)
    texts = []
    for node in ast.walk(tree):
        if isinstance(node, ast.JoinedStr):
            skipped |= set(node.values)
            parts = [str(x.value) if isinstance(x, ast.Constant) else "_" for x in node.values]
            texts.append("".join(parts))
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and node not in skipped:
            texts.append(node.value)
    return [text for text in texts if len(text.split()) > 1]


def api_docs() -> list[str]:
    texts = []
    for name in spelgen.__all__:
        member = getattr(spelgen, name)
        texts.append(inspect.getdoc(member) or "")
        if inspect.isclass(member):
            public = [x for key, x in vars(member).items() if not key.startswith("_")]
            texts += [inspect.getdoc(x) or "" for x in public if callable(x) or isinstance(x, property)]
    for path in (ROOT / "spelgen/cli").glob("*.py"):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        texts += [ast.get_docstring(x) or "" for x in tree.body if isinstance(x, ast.FunctionDef)]
    return texts


def test_messages():
    found = {}
    for path in sorted((ROOT / "spelgen").rglob("*.py")):
        place = path.relative_to(ROOT / "spelgen").as_posix()
        if not place.startswith(INTERNAL):
            found |= {f"{place}: {text}": wrong(text) for text in messages(path) if wrong(text)}
    assert found == {}


def test_docstrings_of_the_api():
    assert {text: wrong(text) for text in api_docs() if wrong(text)} == {}


@pytest.mark.parametrize(
    "path", [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))], ids=lambda x: x.name
)
def test_docs(path):
    text = CODE.sub(" ", path.read_text(encoding="utf-8"))
    lines = [line.strip("#-*| ") for line in text.splitlines()]
    assert {line: wrong(line) for line in lines if wrong(line)} == {}


@pytest.mark.parametrize("path", sorted((ROOT / "templates").glob("*.html.jinja")), ids=lambda x: x.name)
def test_pages(path):
    text = re.sub(r"{%.*?%}|{{.*?}}|<[^>]*>", " ", path.read_text(encoding="utf-8"), flags=re.DOTALL)
    assert {line: wrong(line) for line in text.splitlines() if wrong(line.strip())} == {}


def test_docstrings_and_comments_do_not_get_worse():
    """The number of each unclear construction in a package, counted by tests/words.py, is at most its stored bound.

    The bounds, in tests/golden/words.json, are only lowered (`python tests/words.py --write`).
    """
    bounds = words.bounds()
    rows = [(package, *each) for package, counter in words.counts().items() for each in counter.items()]
    exceeded = {
        f"{package}: {name}": f"{count}, at most {bound}"
        for package, name, count in rows
        if count > (bound := bounds.get(package, {}).get(name, 0))
    }
    assert exceeded == {}, "see tests/words.py"


def test_constructions_are_found_in_docstrings_and_comments(tmp_path):
    path = tmp_path / "module.py"
    path.write_text(
        '"""Return what is left."""\nx = 1  # by joint, told twice\n"""Hold one."""\ny = "what"\n'
    )
    found = [words.constructions(text) for _, text in words.texts(path)]
    assert sum(found, words.Counter()) == {
        "what, whatever": 1, "Return what, which, how, ...": 1, "miss, leave (of residuals)": 1,
        "by (per, with respect to)": 1, "say, tell (of data)": 1, "Hold, opening a docstring": 1,
    }  # fmt: skip
    old = {"a": {"alike": 3, "alone (only)": 1}, "b": {"alike": 1}}
    assert words.lowered({"a": words.Counter({"alike": 2, "alone (only)": 4})}, old) == {
        "a": {"alike": 2, "alone (only)": 1}
    }


def test_the_list_finds_its_words():
    assert wrong("held-out samples ask for no more") and wrong("What servos lose")
    assert not wrong("the arm starts at rest") and not wrong("pass --trust")
