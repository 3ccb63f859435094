"""Tables of results, a column for each predictor or model: for the terminal, notebooks and pages."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from spelgen.baselines.names import observed
from spelgen.labels import thousandths
from spelgen.listing import Listing, number


@dataclass(frozen=True)
class Cell:
    """A number as text; `best`: the smallest of its row, where there is something to compare it with."""

    text: str
    best: bool = False


@dataclass(frozen=True)
class Row:
    """One quantity, in every column."""

    label: str
    cells: tuple[Cell, ...]


@dataclass(frozen=True)
class Table:
    """Quantities down, predictors or models across; `title` says what the numbers are, `note` what rows mean."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[Row, ...]
    note: str = ""

    def text(self) -> str:
        """For a terminal; the best of each row is starred."""
        return self.listing().text()

    def listing(self) -> Listing:
        """The same as text."""
        head = ("", *(f"{name}  " for name in self.columns))
        rows = tuple(
            (row.label, *(cell.text + (" *" if cell.best else "  ") for cell in row.cells))
            for row in self.rows
        )
        return Listing(self.title, head, rows, self.note)


OBSERVER = "+ observer: holds the disturbance that a momentum observer finds in the 0.1 s before; all else is open loop"
UNITS = {"revolute": ("rad", "rad/s", "Nm"), "prismatic": ("m", "m/s", "N")}


def result_tables(evaluation: Mapping[str, Any], joint_types: Sequence[str] = ()) -> list[Table]:
    """The tables of evaluation.json: errors by horizon, by joint at the longest one, torque errors.

    joint_types: those of the evaluation by default; units are only those of joints that there are.
    """
    types = joint_types or evaluation.get("joint_types") or ()
    tables, horizons = _replay_tables(evaluation, types), evaluation["horizons"]
    if horizons:
        title = "Error relative to the motion (0: none, 1: as if the arm had stood still)"
        heads = [_ahead(horizon) for horizon in horizons]
        holds = any(observed(name) in horizon["errors"] for horizon in horizons for name in horizon["errors"])
        rows = [_of(horizon, "mean_relative_rms") for horizon in horizons]
        tables.append(replace(table(title, heads, rows), note=OBSERVER if holds else ""))
        tips = [_of(horizon, "tip_mm") for horizon in horizons]
        if any(value is not None for tip in tips for value in tip.values()):
            tables.append(table("Error of the tip's position [mm]", heads, tips))
        for k, (what, title) in enumerate((("q", "Position error"), ("qd", "Velocity error"))):
            unit, labels = _units(evaluation["joints"], types, k)
            tables.append(_by_joint(f"{title}{unit} after {heads[-1]}", labels, _of(horizons[-1], what)))
    torque = evaluation["torque"]
    if torque:
        mean = {name: errors["mean_nmse"] for name, errors in torque.items()}
        tables.append(table("Torque error of the inverse dynamics", ["nMSE, mean of all"], [mean]))
        rmse = {name: errors["rmse"] for name, errors in torque.items()}
        unit, labels = _units(evaluation["joints"], types, 2)
        tables.append(_by_joint(f"Torque error by joint, RMSE{unit}", labels, rmse))
    return tables


def _replay_tables(evaluation: Mapping[str, Any], types: Sequence[str]) -> list[Table]:
    """Of commands replayed: by trajectory and by joint."""
    tables, unit = [], thousandths(types)
    for replay in evaluation.get("replays", ()):
        errors = replay["errors"]
        names = list(next(iter(errors.values()))["trajectories"])
        rows = [{who: 1000 * each["trajectories"][name] for who, each in errors.items()} for name in names]
        rows.append({who: 1000 * each["mean"] for who, each in errors.items()})
        title = f"Commands replayed, {replay['name']}: RMS of positions over all joints [{unit}]"
        tables.append(table(title, [*names, "mean of these"], rows))
        by_joint = {who: [1000 * x for x in each["joints"]] for who, each in errors.items()}
        title = f"The same by joint, over all trajectories [{unit}]"
        tables.append(_by_joint(title, evaluation["joints"], by_joint))
    return tables


def _units(joints: Sequence[str], types: Sequence[str], quantity: int) -> tuple[str, list[str]]:
    """The unit for a title where all joints have the same, else each beside its joint."""
    if not types:
        return f" [{', '.join(each[quantity] for each in UNITS.values())}]", list(joints)
    units = [UNITS[kind][quantity] for kind in types]
    if len(set(units)) == 1:
        return f" [{units[0]}]", list(joints)
    return "", [f"{joint} [{unit}]" for joint, unit in zip(joints, units, strict=True)]


def _ahead(horizon: Mapping[str, Any]) -> str:
    """How far a horizon looks: `10 steps (0.106 s)`."""
    name = str(horizon["name"])
    return name if name.endswith(" s") else f"{name} ({horizon['seconds']:.3g} s)"


def _of(horizon: Mapping[str, Any], what: str) -> dict[str, Any]:
    return {predictor: errors[what] for predictor, errors in horizon["errors"].items()}


def _by_joint(title: str, joints: Sequence[str], values: Mapping[str, Sequence[float | None]]) -> Table:
    return table(
        title, joints, [{name: each[k] for name, each in values.items()} for k in range(len(joints))]
    )


def table(title: str, labels: Sequence[str], rows: Iterable[Mapping[str, float | None]]) -> Table:
    """Rows of numbers by column, the least of each marked."""
    rows = list(rows)
    names = tuple(dict.fromkeys(name for row in rows for name in row))
    cells = [_cells(row, names) for row in rows]
    laid = tuple(Row(label, each) for label, each in zip(labels, cells, strict=True))
    return Table(title, names, laid)


def _cells(row: Mapping[str, float | None], names: Sequence[str]) -> tuple[Cell, ...]:
    known = [value for value in row.values() if value is not None]
    least = min(known, default=None) if len(row) > 1 else None
    cells = {name: Cell(number(value), value is not None and value == least) for name, value in row.items()}
    return tuple(cells.get(name, Cell("")) for name in names)
