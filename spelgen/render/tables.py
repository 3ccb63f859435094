"""Tables of a run's results against its rivals, laid out once for the terminal and for the report."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from spelgen.listing import number

WIDTH = 80
WIDEST_LABEL = 30
MODEL = "model"  # the trained model among the contenders


@dataclass(frozen=True)
class Cell:
    """A number as text; `best`: the smallest of its row, where there is something to compare it with."""

    text: str
    best: bool = False


@dataclass(frozen=True)
class Row:
    """One quantity, as every contender has it."""

    label: str
    cells: tuple[Cell, ...]


@dataclass(frozen=True)
class Table:
    """Quantities down, contenders across; `title` says what the numbers are."""

    title: str
    contenders: tuple[str, ...]
    rows: tuple[Row, ...]

    def text(self) -> str:
        """The table for a terminal; the best of each row is starred."""
        head = ["", *(f"{name}  " for name in self.contenders)]
        lines = [head]
        for row in self.rows:
            label = textwrap.shorten(row.label, WIDEST_LABEL, placeholder="...")
            lines.append([label, *(cell.text + (" *" if cell.best else "  ") for cell in row.cells)])
        widths = [max(len(line[k]) for line in lines) for k in range(len(head))]
        laid = [
            f"  {line[0]:<{widths[0]}}"
            + "".join(f"  {x:>{w}}" for x, w in zip(line[1:], widths[1:], strict=True))
            for line in lines
        ]
        return "\n".join([*textwrap.wrap(self.title, WIDTH), *(line.rstrip() for line in laid)])


def result_tables(evaluation: Mapping[str, Any]) -> list[Table]:
    """The tables of evaluation.json: errors by horizon, by joint at the longest one, torque errors."""
    tables, horizons = [], evaluation["horizons"]
    if horizons:
        heads = [_ahead(horizon) for horizon in horizons]
        title = "Error relative to the motion (0: none, 1: as if the arm had stood still)"
        tables.append(_table(title, heads, [_of(horizon, "mean_share") for horizon in horizons]))
        tips = [_of(horizon, "tip_mm") for horizon in horizons]
        if any(value is not None for tip in tips for value in tip.values()):
            tables.append(_table("Error of the tip's position [mm]", heads, tips))
        for what, title in (("q", "Position error [rad, m]"), ("qd", "Velocity error [rad/s, m/s]")):
            tables.append(
                _by_joint(f"{title} after {heads[-1]}", evaluation["joints"], _of(horizons[-1], what))
            )
    torque = evaluation["torque"]
    if torque:
        mean = {name: errors["mean_nmse"] for name, errors in torque.items()}
        tables.append(_table("Torque error of the inverse dynamics", ["nMSE, mean of all"], [mean]))
        rmse = {name: errors["rmse"] for name, errors in torque.items()}
        tables.append(_by_joint("Torque error by joint, RMSE [Nm, N]", evaluation["joints"], rmse))
    return tables


def verdict(evaluation: Mapping[str, Any]) -> str:
    """One sentence: at which horizons the model's relative error is the least."""
    best: dict[str, str | None] = {}
    for horizon in evaluation["horizons"]:
        errors = {name: value for name, value in _of(horizon, "mean_share").items() if value is not None}
        best[horizon["name"]] = min(errors, key=errors.__getitem__, default=None)
    won = [name for name, contender in best.items() if contender == MODEL]
    if not best:
        return "No horizon was evaluated."
    if not won:
        return "At no horizon does the model predict better than its rivals."
    lost = [f"; over {name} {each or 'nothing'} is better" for name, each in best.items() if each != MODEL]
    return f"The model predicts best over {_listed(won)}{''.join(lost)}."


def _ahead(horizon: Mapping[str, Any]) -> str:
    """How far a horizon looks: `10 steps (0.106 s)`."""
    name = str(horizon["name"])
    return name if name.endswith(" s") else f"{name} ({horizon['seconds']:.3g} s)"


def _of(horizon: Mapping[str, Any], what: str) -> dict[str, Any]:
    return {contender: errors[what] for contender, errors in horizon["errors"].items()}


def _by_joint(title: str, joints: Sequence[str], values: Mapping[str, Sequence[float | None]]) -> Table:
    return _table(
        title, joints, [{name: each[k] for name, each in values.items()} for k in range(len(joints))]
    )


def _table(title: str, labels: Sequence[str], rows: Iterable[Mapping[str, float | None]]) -> Table:
    rows = list(rows)
    cells = [_cells(list(row.values())) for row in rows]
    laid = tuple(Row(label, each) for label, each in zip(labels, cells, strict=True))
    return Table(title, tuple(rows[0]), laid)


def _cells(values: Sequence[float | None]) -> tuple[Cell, ...]:
    least = min((value for value in values if value is not None), default=None) if len(values) > 1 else None
    return tuple(Cell(number(value), value is not None and value == least) for value in values)


def _listed(names: Sequence[str]) -> str:
    """`a`, `a and b`, `a, b and c`."""
    return " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)
