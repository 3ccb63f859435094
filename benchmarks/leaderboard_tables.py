"""Tables of the results of `leaderboard.py`."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from datetime import date
from pathlib import Path

import numpy as np

DEFAULT = "hybrid"
REFERENCES = ("URDF", "ridge", "least squares", "with memory", "closed-form")
# Goals for the error of `DEFAULT` divided by the smallest error of `REFERENCES`: largest ratio on 95 % of the cells
# (fold, training duration, group of test recordings), and on every cell.
GOALS = (1.05, 1.25)
MARKS = "<!-- leaderboard -->", "<!-- end of leaderboard -->"
LARGE = 100.0  # [1] nMSE above which tables print only "> 100"

Row = dict[str, object]
Cell = tuple[str, str, str]
"""Fold, duration, group of test recordings."""


def cells_of(rows: Iterable[Row]) -> dict[Cell, dict[str, float]]:
    """Return {cell: {method: nMSE}}, computed over test samples in which a joint moves.

    A cell is a fold, the duration of its training data, and a group of its test recordings. rows: results of
    `leaderboard.py`; failed fits are omitted.
    """
    cells: dict[Cell, dict[str, float]] = {}
    for row in rows:
        groups = row.get("nmse")
        if isinstance(groups, dict):
            for group, (moving, _) in groups.items():
                cell = str(row["fold"]), str(row["seconds"]), group
                cells.setdefault(cell, {})[str(row["method"])] = moving
    return cells


def errors_table(cells: Mapping[Cell, Mapping[str, float]], methods: Sequence[str]) -> list[list[str]]:
    """Return the table of nMSE per method, with a row for each cell (fold, duration, group of test recordings).

    The last column is the error of `hybrid` divided by the smallest error of the reference methods (`ratio_to_best`).
    A motion pair is a fold that is trained on one motion and tested on another. All motion pairs of an arm and a
    duration share one row, with medians over the pairs.
    """
    table: dict[tuple[str, str, str], list[Mapping[str, float]]] = {}
    for (fold, seconds, group), errors in cells.items():
        arm, kind = fold.split("/")
        if kind.startswith("motion"):
            fold, group = f"{arm}/motion pairs", ""
        table.setdefault((fold, seconds, group), []).append(errors)
    lines = [["fold", "trained on [s]", "tested on", *methods, f"{DEFAULT} / best"]]
    for (fold, seconds, group), each in table.items():
        medians = [_median([x[name] for x in each if name in x]) for name in methods]
        label = group or f"{len(each)} pairs, median"
        ratios = [ratio for x in each if (ratio := ratio_to_best(x)) is not None]
        lines.append([fold, seconds, label, *medians, f"{np.median(ratios):.2f}" if ratios else "-"])
    return lines


def _median(values: Sequence[float]) -> str:
    if not values:
        return "-"
    median = float(np.median(values))
    return f"{median:.3g}" if median <= LARGE else f"> {LARGE:g}"


def ratio_to_best(errors: Mapping[str, float]) -> float | None:
    """Return the nMSE of `hybrid` divided by the smallest nMSE of the methods in `REFERENCES`.

    errors: {method: nMSE}. Return None if `errors` lacks `hybrid`, or all of `REFERENCES`.
    """
    best = min((errors[name] for name in REFERENCES if name in errors), default=None)
    return None if best is None or DEFAULT not in errors else errors[DEFAULT] / best


def summary(cells: Mapping[Cell, Mapping[str, float]]) -> list[str]:
    """Return lines that summarize the ratios of `ratio_to_best` over all cells.

    A cell is a fold, a duration and a group of test recordings. Cells with ratios above `GOALS[1]` are listed.
    """
    ratios = {cell: x for cell, errors in cells.items() if (x := ratio_to_best(errors)) is not None}
    if not ratios:
        return []
    lines = []
    groups = {"all": ratios}
    for cell, ratio in ratios.items():
        kind = "motion pairs" if "/motion" in cell[0] else "splits"
        for name in (kind, f"{cell[1]} s" if cell[1] != "all" else "all data"):
            groups.setdefault(name, {})[cell] = ratio
    for name, chosen in groups.items():
        values = np.array(list(chosen.values()))
        share = 100 * (values <= GOALS[0]).mean()
        lines.append(
            f"{DEFAULT} / best, {name}: median {np.median(values):.3f}, 95 % quantile "
            f"{np.quantile(values, 0.95):.3f}, maximum {values.max():.3f}; "
            f"at most {GOALS[0]} on {share:.0f} % of {len(values)} cells"
        )
    worst = sorted(((x, cell) for cell, x in ratios.items() if x > GOALS[1]), reverse=True)
    lines += [f"  above {GOALS[1]}: {x:.2f}  {', '.join(cell)}" for x, cell in worst]
    return lines


def changes(
    before: Mapping[Cell, Mapping[str, float]],
    now: Mapping[Cell, Mapping[str, float]],
    methods: Iterable[str],
) -> list[str]:
    """Return a line per method about the ratios nMSE now / nMSE before, over cells that `before` and `now` contain.

    A line has median, geometric mean, maximum and minimum of the ratios, and the shares above 1.03 and below 0.97.
    """
    lines = []
    for name in methods:
        ratios = {
            cell: errors[name] / before[cell][name]
            for cell, errors in now.items()
            if name in errors and before.get(cell, {}).get(name)
        }
        if ratios:
            values, worst = np.array(list(ratios.values())), max(ratios, key=lambda cell: ratios[cell])
            lines.append(
                f"{name} / before: median {np.median(values):.3f}, geometric mean "
                f"{np.exp(np.log(values).mean()):.3f}, {np.mean(values > 1.03):.0%} worse by more than 3 %, "
                f"{np.mean(values < 0.97):.0%} better; maximum {ratios[worst]:.2f} ({', '.join(worst)}), "
                f"minimum {values.min():.2f}; {len(values)} cells"
            )
    return lines


def text(table: Sequence[Sequence[str]]) -> str:
    """Return a table as lines of text: the first three columns are aligned at the left margin, others at the right.

    table: rows of strings.
    """
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    return "\n".join(
        "  ".join(
            x.ljust(w) if k < 3 else x.rjust(w) for k, (x, w) in enumerate(zip(row, widths, strict=True))
        )
        for row in table
    )


def method_lines(rows: Sequence[Row], methods: Sequence[str]) -> list[list[str]]:
    """Return the table of the methods: number of fits, median fit time, coverage of 95 % torque intervals."""
    table = [["method", "fits", "median fit [CPU s]", "longest", "torques within 95 % intervals"]]
    for name in methods:
        each = [row for row in rows if row["method"] == name and "nmse" in row]
        times = [x for row in each if isinstance(x := row["fit_s"], float)]
        shares = [
            x for row in each if isinstance(groups := row.get("coverage"), dict) for x in groups.values()
        ]
        if each:
            covered = f"{np.mean(shares):.0%}" if shares else "-"
            table.append([name, str(len(each)), f"{np.median(times):.2g}", f"{max(times):.2g}", covered])
    return table


def write_page(
    page: Path, rows: Sequence[Row], cells: Mapping[Cell, Mapping[str, float]], methods: Sequence[str]
) -> None:
    """Replace the text between the two `MARKS` of a Markdown page by the date, the summary and the tables."""
    text = page.read_text()
    before, rest = text.split(MARKS[0])
    after = rest.split(MARKS[1])[1]
    present = [name for name in methods if any(name in errors for errors in cells.values())]
    parts = [
        f"Made on {date.today():%d %B %Y} by `python benchmarks/leaderboard.py`; {len(cells)} cells.",
        *_lists(summary(cells)),
        markdown(errors_table(cells, present)),
        markdown(method_lines(rows, present)),
    ]
    page.write_text("\n\n".join([before + MARKS[0], *parts, MARKS[1]]) + after)


def _lists(lines: Sequence[str]) -> Iterator[str]:
    """Yield the lines of a summary as a Markdown list; indented lines become items of the second level."""
    yield "\n".join(f"    - {x.strip()}" if x.startswith(" ") else f"- {x}" for x in lines)


def markdown(table: Sequence[Sequence[str]]) -> str:
    """Return a table of cells, whose first row is the head, as Markdown."""
    head, *rows = table
    return "\n".join(f"|{'|'.join(row)}|" for row in [head, ["---"] * len(head), *rows])
