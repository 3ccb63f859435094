"""Tables of results, a column for each predictor or model: for the terminal, notebooks and pages."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, TypeVar

from spelgen.baselines.names import MODEL, observed
from spelgen.labels import thousandths
from spelgen.listing import Listing, number

if TYPE_CHECKING:
    from spelgen.evaluation.figures import Figures

OBSERVER = (
    "+ observer: with the constant disturbance that a momentum observer estimates from the 0.1 s before; "
    "all others are open-loop"
)
UNITS = {"revolute": ("rad", "rad/s", "Nm"), "prismatic": ("m", "m/s", "N")}
POSITION, VELOCITY, TORQUE = range(3)  # in these


@dataclass(frozen=True)
class Cell:
    """A number as text; `best`: the smallest of its row, where there is something to compare it with.

    value: all its digits; None where it is not known.
    """

    text: str
    best: bool = False
    value: float | None = None


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
        """Return it for a terminal; the best of each row is starred."""
        return self.listing().text()

    def listing(self) -> Listing:
        """Return the same as text."""
        lines = []
        for row in self.rows:
            texts = [row.label]
            for cell in row.cells:
                texts.append(f"{cell.text} *" if cell.best else f"{cell.text}  ")
            lines.append(tuple(texts))
        head = ("", *(f"{name}  " for name in self.columns))
        return Listing(self.title, head, tuple(lines), self.note)


Numbers = Mapping[str, float | None]
"""By column."""
Errors = TypeVar("Errors")
Value = TypeVar("Value")


def table(title: str, labels: Sequence[str], rows: Iterable[Numbers], note: str = "") -> Table:
    """Return rows of numbers by column, the least of each marked."""
    numbers = list(rows)
    columns: dict[str, None] = {}
    for row in numbers:
        columns |= dict.fromkeys(row)
    lines = []
    for label, row in zip(labels, numbers, strict=True):
        lines.append(Row(label, _cells(row, columns)))
    return Table(title, tuple(columns), tuple(lines), note)


def _cells(row: Numbers, columns: Iterable[str]) -> tuple[Cell, ...]:
    smallest = None
    if len(row) > 1:  # alone it would be the best of nothing
        smallest = min(known(row.values()), default=None)
    cells = []
    for name in columns:
        value = row.get(name)
        text = number(value) if name in row else ""
        cells.append(Cell(text, value is not None and value == smallest, value))
    return tuple(cells)


def result_tables(results: Figures) -> list[Table]:
    """Return the tables of an evaluation: commands replayed, errors by horizon and by joint, torques."""
    tables = [*_replay_tables(results), *_horizon_tables(results), *_torque_tables(results)]
    return list(map(_without_empty_columns, tables))


def _without_empty_columns(table: Table) -> Table:
    """Return the table without baselines whose cells are all dashes or empty."""
    filled: set[int] = {table.columns.index(MODEL)} if MODEL in table.columns else set()
    for row in table.rows:
        for k, cell in enumerate(row.cells):
            if cell.text not in ("", "-"):
                filled.add(k)
    chosen = sorted(filled)
    rows = []
    for row in table.rows:
        rows.append(Row(row.label, tuple(row.cells[k] for k in chosen)))
    return replace(table, columns=tuple(table.columns[k] for k in chosen), rows=tuple(rows))


def _values(errors: Mapping[str, Errors], value: Callable[[Errors], Value]) -> dict[str, Value]:
    """Return one value of the errors of each predictor."""
    return {name: value(of_predictor) for name, of_predictor in errors.items()}


def _horizon_tables(results: Figures) -> list[Table]:
    if not results.horizons:
        return []
    heads, relative, tips, note = [], [], [], ""
    for horizon in results.horizons:
        head = horizon.name
        if not head.endswith(" s"):
            head = f"{head} ({horizon.seconds:.3g} s)"
        heads.append(head)
        relative.append(_values(horizon.errors, lambda x: x.mean_relative_rms))
        tips.append(_values(horizon.errors, lambda x: x.tip_mm))
        if observed(MODEL) in horizon.errors:
            note = OBSERVER
    title = "Error relative to the motion (0: none, 1: as if the arm had stood still)"
    tables = [table(title, heads, relative, note)]
    # no tip is known without a URDF
    if any(known(row.values()) for row in tips):
        tables.append(table("Error of the tip's position [mm]", heads, tips))
    last = results.horizons[-1].errors
    positions, velocities = _values(last, lambda x: x.q), _values(last, lambda x: x.qd)
    tables.append(_by_joint(results, "Position error{} after " + heads[-1], POSITION, positions))
    tables.append(_by_joint(results, "Velocity error{} after " + heads[-1], VELOCITY, velocities))
    return tables


def _torque_tables(results: Figures) -> list[Table]:
    torque = results.torque
    if not torque:
        return []
    rows = {
        "mean of joints": _values(torque, lambda x: x.mean_nmse),
        "with pauses": _values(torque, lambda x: x.nmse_with_pauses),
        "worst joint": _values(torque, lambda x: _largest(x.joint_nmse)),
    }
    by_joint = _by_joint(results, "Torque error by joint, RMSE{}", TORQUE, _values(torque, lambda x: x.rmse))
    if results.torque_steps:
        by_joint = replace(
            by_joint, note=f"logged in steps of their own size: {', '.join(results.torque_steps)}"
        )
    return [
        table("Torque error of the inverse dynamics, nMSE over all test samples", list(rows), rows.values()),
        by_joint,
    ]


def _largest(values: Sequence[float | None]) -> float | None:
    return max(known(values), default=None)


def known(values: Iterable[float | None]) -> list[float]:
    """Return the values that are known."""
    return [value for value in values if value is not None]


def _replay_tables(results: Figures) -> list[Table]:
    """Return those of commands replayed: by trajectory and by joint."""
    tables, unit = [], thousandths(results.joint_types)
    for replay in results.replays:
        trajectories = list(replay.errors[MODEL].trajectories)
        rows = []
        for trajectory in trajectories:
            rows.append(_values(replay.errors, lambda x: 1000 * x.trajectories[trajectory]))  # noqa: B023
        rows.append(_values(replay.errors, lambda x: 1000 * x.mean))
        title = f"Commands replayed, {replay.name}: RMS of positions over all joints [{unit}]"
        tables.append(table(title, [*trajectories, "mean of these"], rows))
        by_joint = []
        for k in range(len(results.joints)):
            by_joint.append(_values(replay.errors, lambda x: 1000 * x.joints[k]))  # noqa: B023
        tables.append(table(f"The same by joint, over all trajectories [{unit}]", results.joints, by_joint))
    return tables


def _by_joint(
    results: Figures, title: str, quantity: int, values: Mapping[str, Sequence[float | None]]
) -> Table:
    """Return a row for each joint; the unit stands in the title where all have the same, else beside each joint."""
    units = [UNITS[kind][quantity] for kind in results.joint_types]
    labels = list(results.joints)
    common = ""
    if len(set(units)) == 1:
        common = f" [{units[0]}]"
    else:
        labels = [f"{joint} [{unit}]" for joint, unit in zip(labels, units, strict=True)]
    rows = [_values(values, lambda x: x[k]) for k in range(len(labels))]  # noqa: B023
    return table(title.format(common), labels, rows)
