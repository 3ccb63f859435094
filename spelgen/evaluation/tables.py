"""Tables of results, a column for each predictor or model: for the terminal, notebooks and pages."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from spelgen.baselines.names import observed
from spelgen.labels import thousandths
from spelgen.listing import Listing, number

if TYPE_CHECKING:
    from spelgen.evaluation.results import Results

OBSERVER = "+ observer: holds the disturbance that a momentum observer finds in the 0.1 s before; all else is open loop"
UNITS = {"revolute": ("rad", "rad/s", "Nm"), "prismatic": ("m", "m/s", "N")}
POSITION, VELOCITY, TORQUE = range(3)  # in these


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
        """Return it for a terminal; the best of each row is starred."""
        return self.listing().text()

    def listing(self) -> Listing:
        """Return the same as text."""
        lines = []
        for row in self.rows:
            stars = [cell.text + (" *" if cell.best else "  ") for cell in row.cells]
            lines.append((row.label, *stars))
        head = ("", *(f"{name}  " for name in self.columns))
        return Listing(self.title, head, tuple(lines), self.note)


Numbers = Mapping[str, float | None]
"""By column."""


def table(title: str, labels: Sequence[str], rows: Iterable[Numbers], note: str = "") -> Table:
    """Return rows of numbers by column, the least of each marked."""
    numbers = list(rows)
    columns: dict[str, None] = {}
    for row in numbers:
        columns |= dict.fromkeys(row)
    lines = [Row(label, _cells(row, columns)) for label, row in zip(labels, numbers, strict=True)]
    return Table(title, tuple(columns), tuple(lines), note)


def _cells(row: Numbers, columns: Iterable[str]) -> tuple[Cell, ...]:
    least = None
    if len(row) > 1:
        least = min((value for value in row.values() if value is not None), default=None)
    cells = []
    for name in columns:
        value = row.get(name)
        text = number(value) if name in row else ""
        cells.append(Cell(text, best=value is not None and value == least))
    return tuple(cells)


def result_tables(results: Results) -> list[Table]:
    """Return the tables of an evaluation: commands replayed, errors by horizon and by joint, torques."""
    return [*_replay_tables(results), *_horizon_tables(results), *_torque_tables(results)]


def _horizon_tables(results: Results) -> list[Table]:
    horizons = results.horizons
    if not horizons:
        return []
    heads = []
    for horizon in horizons:  # `10 steps (0.106 s)`
        in_seconds = horizon.name.endswith(" s")
        heads.append(horizon.name if in_seconds else f"{horizon.name} ({horizon.seconds:.3g} s)")
    relative = [{name: errors.mean_relative_rms for name, errors in x.errors.items()} for x in horizons]
    tips = [{name: errors.tip_mm for name, errors in x.errors.items()} for x in horizons]
    note = OBSERVER if any(observed(name) in x.errors for x in horizons for name in x.errors) else ""
    title = "Error relative to the motion (0: none, 1: as if the arm had stood still)"
    tables = [table(title, heads, relative, note)]
    if any(value is not None for row in tips for value in row.values()):
        tables.append(table("Error of the tip's position [mm]", heads, tips))
    last = horizons[-1].errors
    positions = {name: errors.q for name, errors in last.items()}
    velocities = {name: errors.qd for name, errors in last.items()}
    tables.append(_by_joint(results, "Position error{} after " + heads[-1], POSITION, positions))
    tables.append(_by_joint(results, "Velocity error{} after " + heads[-1], VELOCITY, velocities))
    return tables


def _torque_tables(results: Results) -> list[Table]:
    if not results.torque:
        return []
    mean = {name: errors.mean_nmse for name, errors in results.torque.items()}
    by_joint = {name: errors.rmse for name, errors in results.torque.items()}
    return [
        table("Torque error of the inverse dynamics", ["nMSE, mean of all"], [mean]),
        _by_joint(results, "Torque error by joint, RMSE{}", TORQUE, by_joint),
    ]


def _replay_tables(results: Results) -> list[Table]:
    """Return those of commands replayed: by trajectory and by joint."""
    tables, unit = [], thousandths(results.joint_types)
    for replay in results.replays:
        trajectories = list(next(iter(replay.errors.values())).trajectories)
        rows = []
        for trajectory in trajectories:
            rows.append({who: 1000 * x.trajectories[trajectory] for who, x in replay.errors.items()})
        rows.append({who: 1000 * x.mean for who, x in replay.errors.items()})
        title = f"Commands replayed, {replay.name}: RMS of positions over all joints [{unit}]"
        tables.append(table(title, [*trajectories, "mean of these"], rows))
        by_joint = []
        for k in range(len(results.joints)):
            by_joint.append({who: 1000 * x.joints[k] for who, x in replay.errors.items()})
        tables.append(table(f"The same by joint, over all trajectories [{unit}]", results.joints, by_joint))
    return tables


def _by_joint(
    results: Results, title: str, quantity: int, values: Mapping[str, Sequence[float | None]]
) -> Table:
    """Return a row for each joint; the unit stands in the title where all have the same, else beside each joint."""
    units = [UNITS[kind][quantity] for kind in results.joint_types]
    labels = list(results.joints)
    if len(set(units)) == 1:
        title = title.format(f" [{units[0]}]")
    else:
        title = title.format("")
        labels = [f"{joint} [{unit}]" for joint, unit in zip(labels, units, strict=True)]
    rows = [{name: column[k] for name, column in values.items()} for k in range(len(labels))]
    return table(title, labels, rows)
