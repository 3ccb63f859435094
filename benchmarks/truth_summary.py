"""Tables of the results of `truth.py`: errors, `hybrid` relative to least squares, intervals, residual statistics."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from intervals import QUANTITIES
from residual_statistics import of_recordings
from residual_statistics import table as residual_table

Row = dict[str, Any]

DEFAULT = "hybrid"
LEAST_SQUARES = ("identify", "identify --memory")
CAUSES: dict[str, Callable[[Row], Any]] = {
    "errors": lambda row: "realistic" if row.get("errors") else "white noise only",
    "friction": lambda row: row["friction"],
    "noise": lambda row: row["noise"],
    "seconds": lambda row: row["seconds"],
    "urdf_error": lambda row: row["urdf_error"],
    "motion": lambda row: row["motion"],
    "sample_rate": lambda row: row["sample_rate"],
}


def summary(rows: Sequence[Row], methods: Sequence[str], recordings: Path | None = None) -> str:
    """Return all tables as text, over the cases (rows) in which neither `hybrid` nor least squares failed.

    methods: names of the methods in the table of errors. recordings: folder of recordings, with whose torque residuals
    the residuals of simulated arms are compared.
    """
    ours = (DEFAULT, *LEAST_SQUARES)
    good = [row for row in rows if not any("error" in row["results"][name] for name in ours)]
    if not good:
        return f"all of {len(rows)} cases have an error"
    return "\n".join([
        *error_lines(good, methods), *ratio_lines(good), "", *interval_lines(good), "",
        residual_table(dict(residual_rows(good, recordings))), f"{len(rows) - len(good)} cases with an error",
    ])  # fmt: skip


def error_lines(rows: Sequence[Row], methods: Sequence[str]) -> Iterator[str]:
    """Yield the lines of the table of median errors per method, over cases."""
    yield (
        f"{'':20}{'M':>10}{'g':>10}{'base':>10}{'friction':>10}"
        f"{'nMSE':>12}{'filtered':>12}{'worst Mjj':>11}{'s':>7}{'arms':>7}"
    )
    for name in methods:
        each = [row["results"][name] for row in rows if "mass" in row["results"].get(name, {})]
        if not each:
            continue
        columns = [np.median([x[key] for x in each]) for key in ("mass", "gravity", "base", "friction")]
        errors = [np.median([x[key] for x in each]) for key in ("nmse", "nmse_filtered")]
        worst = np.median([np.abs(x["diagonal"]).max() for x in each])
        seconds = np.median([x["seconds"] for x in each])
        yield (
            f"{name:20}" + "".join(f"{x:10.4f}" for x in columns) + "".join(f"{x:12.2e}" for x in errors)
            + f"{worst:11.4f}{seconds:7.1f}{len(each):7}"
        )  # fmt: skip


def ratio_lines(rows: Sequence[Row]) -> Iterator[str]:
    """Yield lines on the ratio (error of `hybrid`) / (smaller error of the two least-squares methods).

    There is a ratio for the error of M, and one for the nMSE of the torque. The lines have the median of each ratio and
    the share of cases with a ratio below a limit such as 1.2: for all cases, then per property of the cases, such as
    the kind of friction (`CAUSES`).
    """
    for key, goal in (("mass", 1.2), ("nmse", 1.02)):
        ratio = np.array([by_better_least_squares(row, key) for row in rows])
        limits = sorted({1.0, 1.02, 1.2, 2.0})
        shares = ", ".join(f"at most {x:g} on {100 * (ratio <= x).mean():.1f} %" for x in limits)
        worst = sorted(zip(ratio, (row["number"] for row in rows), strict=True), reverse=True)[:5]
        yield f"{key}: {DEFAULT} / better least squares: median {np.median(ratio):.2f}; {shares} of {len(rows)}"
        yield "    largest: " + ", ".join(f"{x:.2f} (number {number})" for x, number in worst)
        for cause in CAUSES:
            parts = []
            for value, chosen in by_cause(rows, cause):
                part = ratio[chosen]
                parts.append(f"{value}: {np.median(part):.2f} ({100 * (part <= goal).mean():.0f} %)")
            yield f"    median (share at most {goal:g}) by {cause}: " + ", ".join(parts)


def by_cause(rows: Sequence[Row], cause: str) -> Iterator[tuple[Any, np.ndarray]]:
    """Yield each value of a property of the cases, such as the kind of friction, with the mask (rows,) of its cases.

    cause: key of `CAUSES`, whose function returns the value for a case.
    """
    values = [CAUSES[cause](row) for row in rows]
    for value in sorted(set(values)):
        yield value, np.array([x == value for x in values])


def by_better_least_squares(row: Row, key: str) -> float:
    """Return an error of `hybrid` in a case, divided by the smaller error of the two `LEAST_SQUARES` methods.

    key: name of the error in the results of `truth.py`, for example "mass".
    """
    errors = {name: row["results"][name][key] for name in (DEFAULT, *LEAST_SQUARES)}
    return float(errors[DEFAULT] / min(errors[name] for name in LEAST_SQUARES))


def interval_lines(rows: Sequence[Row]) -> Iterator[str]:
    """Yield lines on the 95 % intervals of `hybrid`, per quantity of `QUANTITIES`, such as base parameters.

    A cell has the share of true values within their intervals [%], which should be 95, and in brackets the relative
    width of the intervals, 1 / (95 % quantile of |error| / half interval): 1 is right, more than 1 is too wide.
    """
    rows = [row for row in rows if "intervals" in row["results"][DEFAULT]]
    if not rows:
        return
    yield "95 % intervals: share of true values within [%], and 1 / (95 % quantile of error / half width)"
    yield f"{'':34}" + "".join(f"{name:>16}" for name in QUANTITIES) + f"{'arms':>8}"
    groups: list[tuple[str, Sequence[Row]]] = [("all", rows)]
    for cause in ("errors", "friction", "noise", "seconds"):
        for value, chosen in by_cause(rows, cause):
            groups.append((f"{cause}: {value}", [x for x, keep in zip(rows, chosen, strict=True) if keep]))
    for name, each in groups:
        cells = []
        for quantity in QUANTITIES:
            ratios = np.concatenate([row["results"][DEFAULT]["intervals"][quantity] for row in each])
            width = 1 / max(np.quantile(ratios, 0.95), 1e-9) if len(ratios) else np.nan
            cells.append(f"{100 * (ratios <= 1).mean():.0f} ({width:.2f})" if len(ratios) else "-")
        yield f"{name:34}" + "".join(f"{x:>16}" for x in cells) + f"{len(each):8}"


def residual_rows(rows: Sequence[Row], recordings: Path | None) -> Iterator[tuple[str, Sequence[float]]]:
    """Yield (name, `ResidualStatistics.columns`) of torque residuals of recordings and of simulated arms.

    Recordings have a row per split, and one with the median over the splits. Simulated arms with and without realistic
    errors have three rows each: the 10 %, 50 % and 90 % quantiles over the cases with logs of at least 20 s.
    """
    if recordings is not None:
        found = {name: x.columns() for name, x in of_recordings(recordings).items()}
        yield from found.items()
        yield "recordings, median", np.median(list(found.values()), axis=0).tolist()
    for value, chosen in by_cause(rows, "errors"):
        each = [row for row, keep in zip(rows, chosen, strict=True) if keep and row["seconds"] >= 20]
        columns = [x for row in each if (x := row["results"][LEAST_SQUARES[1]].get("residual"))]
        for share in (0.1, 0.5, 0.9) if columns else ():
            yield f"{value}, {share:.0%} quantile", np.quantile(columns, share, axis=0).tolist()
