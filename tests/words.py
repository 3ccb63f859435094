"""Count constructions in docstrings and comments for which plain technical English has a noun or a term of the field.

    python tests/words.py          counts per package, and the texts with the highest rates
    python tests/words.py --write  lower the bounds in tests/golden/words.json to the current counts
    python tests/words.py --reset  replace all bounds, for instance after a package was renamed or split

tests/test_words.py fails if a count exceeds its bound; a package without bounds must have none of the constructions.
"""

from __future__ import annotations

import argparse
import ast
import io
import json
import re
import tokenize
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).parents[1]
FOLDERS = ("spelgen", "benchmarks", "tests")
BOUNDS = ROOT / "tests" / "golden" / "words.json"

CONSTRUCTIONS = {
    name: re.compile(pattern, re.IGNORECASE)
    for name, pattern in {
        "what, whatever": r"\bwhat(ever)?\b",
        "Return what, which, how, ...": r"\breturns? (what|which|how|whether|where|of|by)\b",
        "that of, those that, these are": r"\b(that|those) of\b|\bthose (that|which|who)\b"
        r"|\b(these|those) (are|is|have|has|leave|make|give|go|do|read|stand|move)\b",
        "beside, stands": r"\b(beside|stands?|standing)\b",
        "say, tell (of data)": r"\b(says?|said|saying|tells?|told|telling)\b",
        "miss, leave (of residuals)": r"\b(miss(es|ed)?|leaves?)\b|\bmissing torque\b|\b(is|are) left\b",
        "alike": r"\balike\b|\bsays? the same\b",
        "come near, go on": r"\bcomes? near\b|\bnearby\b|\b(goes?|gone|going) on\b",
        "take for, pass for, anew": r"\b(takes?|taken|pass(es|ed)?) for\b|\b(takes?|taken) over\b|\banew\b",
        "as it is, as they are": r"\bas (it is|they are)\b",
        "so many, as many as": r"\bso (many|much)\b|\bas (many|much) as\b",
        "turn around, the way to": r"\bturn(s|ed|ing)? (around|round)\b|\bthe way (here|to|that)\b",
        "by (per, with respect to)": r"\bby (joint|column|body|velocity|position|all weights|weights?|kp|row)\b",
        "remember, know the past": r"\bremember(s|ed|ing)?\b|\bknows? the past\b",
        "worth, luck, believe, honest": r"\b(worth|luck|believ\w*|honest\w*|strangers?|nasty)\b",
        "alone (only)": r"\balone\b",
        "usual, odd, impossible": r"\b(usual|odd|impossible)\b",
        "want, ask, bear, feel": r"\b(wants?|asks?|bears?|borne|feels?)\b",
        "Hold, opening a docstring": r"\A\s*Hold\b",
    }.items()
}


def texts(path: Path) -> list[tuple[int, str]]:
    """Return all docstrings and comments of a file, each with its line."""
    source = path.read_text(encoding="utf-8")
    strings = [
        (node.lineno, node.value.value)
        for node in ast.walk(ast.parse(source))
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
        if isinstance(node.value.value, str)
    ]
    comments = [
        (token.start[0], token.string.lstrip("# "))
        for token in tokenize.generate_tokens(io.StringIO(source).readline)
        if token.type == tokenize.COMMENT
    ]
    return strings + comments


def constructions(text: str) -> Counter[str]:
    """Return {name: number of matches in a text} of the wordings in `CONSTRUCTIONS`; counts of zero are omitted."""
    found = {name: len(list(pattern.finditer(text))) for name, pattern in CONSTRUCTIONS.items()}
    return Counter({name: count for name, count in found.items() if count})


def files() -> list[tuple[str, Path]]:
    """Return (package, path) of each checked file; this file is omitted, as it contains all counted constructions."""
    paths = [path for folder in FOLDERS for path in sorted((ROOT / folder).rglob("*.py"))]
    kept = [path for path in paths if path != Path(__file__) and "golden" not in path.parts]
    return [(path.parent.relative_to(ROOT).as_posix(), path) for path in kept]


def counts() -> dict[str, Counter[str]]:
    """Return {package: {name: number of matches}} of `CONSTRUCTIONS` in all docstrings and comments of the package."""
    found: dict[str, Counter[str]] = {}
    for package, path in files():
        for _, text in texts(path):
            found.setdefault(package, Counter()).update(constructions(text))
    return {package: counter for package, counter in sorted(found.items()) if counter}


def bounds() -> dict[str, dict[str, int]]:
    return json.loads(BOUNDS.read_text(encoding="utf-8"))


def lowered(found: dict[str, Counter[str]], old: dict[str, dict[str, int]]) -> dict[str, dict[str, int]]:
    """Return bounds {package: {name: count}}, each the smaller of the old bound and the current count.

    found: current counts per package, of the names in `CONSTRUCTIONS`. old: old bounds. A count above its old bound
    does not raise the bound. Bounds of zero are omitted, since no bound means zero.
    """
    smaller = {
        package: {name: min(found.get(package, Counter())[name], count) for name, count in row.items()}
        for package, row in old.items()
    }
    rows = {package: {name: x for name, x in row.items() if x} for package, row in smaller.items()}
    return {package: row for package, row in rows.items() if row}


def show(worst: int = 20) -> None:
    """Print counts per 1,000 words of each package, and the texts with the highest rates."""
    words: Counter[str] = Counter()
    rated = []
    for package, path in files():
        for line, text in texts(path):
            length, number = len(text.split()), constructions(text).total()
            words[package] += length
            if number > 1 and length > 5:
                rated.append(
                    (number / length, f"{path.relative_to(ROOT)}:{line}: {' '.join(text.split())[:200]}")
                )
    for package, counter in counts().items():
        print(
            f"{counter.total():5d} {1000 * counter.total() / words[package]:6.1f} per 1,000 words  {package}"
        )
    print(*[text for _, text in sorted(rated, reverse=True)[:worst]], sep="\n")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--write", action="store_true", help="lower the bounds to the current counts")
    parser.add_argument("--reset", action="store_true", help="replace all bounds by the current counts")
    options = parser.parse_args()
    if options.write or options.reset:
        table = counts() if options.reset else lowered(counts(), bounds())
        BOUNDS.write_text(json.dumps(table, indent=1, sort_keys=True) + "\n", encoding="utf-8")
    else:
        show()


if __name__ == "__main__":
    main()
