"""Tables of results, a column for each predictor or model: for the terminal, notebooks and pages."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, TypeVar

from spelgen.baselines.names import MODEL, observed
from spelgen.labels import UNITS, thousandths
from spelgen.listing import Listing, number

if TYPE_CHECKING:
    from spelgen.evaluation.results import Results

OBSERVER = (
    "+ observer: with the constant disturbance that a momentum observer estimates from the 0.1 s before; "
    "all others are open-loop"
)

Numbers = Mapping[str, float | None]
"""By column; None where a number is not known."""
Errors = TypeVar("Errors")
Value = TypeVar("Value")


@dataclass(frozen=True)
class Row:
    """One quantity, in every column that has it. form: of its numbers. ranked: whether the least of them is best."""

    label: str
    values: Numbers
    form: Callable[[float | None], str] = number
    ranked: bool = True

    def text(self, column: str) -> str:
        """Return the number of a column; nothing where it has none."""
        return self.form(self.values[column]) if column in self.values else ""

    @property
    def best(self) -> list[str]:
        """Return the columns with the smallest number, where there is something to compare it with."""
        if not self.ranked or len(self.values) < 2:
            return []
        smallest = min(known(self.values.values()), default=None)
        return [name for name, value in self.values.items() if value is not None and value == smallest]


@dataclass(frozen=True)
class Table:
    """Quantities down, predictors or models across; `title` says what the numbers are, `note` what rows mean."""

    title: str
    rows: tuple[Row, ...]
    note: str = ""

    @property
    def columns(self) -> list[str]:
        """Return the names of all columns, in the order in which rows have them."""
        names: dict[str, None] = {}
        for row in self.rows:
            names |= dict.fromkeys(row.values)
        return list(names)

    def text(self) -> str:
        """Return it for a terminal; the best of each row is starred."""
        return self.listing().text()

    def listing(self) -> Listing:
        """Return the same as text."""
        lines = []
        for row in self.rows:
            texts = [row.label]
            for name in self.columns:
                texts.append(f"{row.text(name)} {'*' if name in row.best else ' '}")
            lines.append(tuple(texts))
        head = ("", *(f"{name}  " for name in self.columns))
        return Listing(self.title, head, tuple(lines), self.note)


def table(title: str, labels: Sequence[str], rows: Iterable[Numbers], note: str = "") -> Table:
    """Return rows of numbers by column, the least of each marked."""
    return Table(title, tuple(map(Row, labels, rows)), note)


def result_tables(results: Results) -> list[Table]:
    """Return the tables of an evaluation: commands replayed, errors by horizon and by joint, torques."""
    tables = [*_replay_tables(results), *_horizon_tables(results), *_torque_tables(results)]
    return list(map(_without_empty_columns, tables))


def _without_empty_columns(table: Table) -> Table:
    """Return the table without the columns of baselines that have no number."""
    empty = {*table.columns} - {MODEL}
    for row in table.rows:
        empty -= {name for name, value in row.values.items() if value is not None}
    rows = []
    for row in table.rows:
        rows.append(replace(row, values={name: row.values[name] for name in row.values if name not in empty}))
    return replace(table, rows=tuple(rows))


def _values(errors: Mapping[str, Errors], value: Callable[[Errors], Value]) -> dict[str, Value]:
    """Return one value of the errors of each predictor."""
    return {name: value(of_predictor) for name, of_predictor in errors.items()}


def _horizon_tables(results: Results) -> list[Table]:
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
    tables += _by_joint(results, f"Position error{{}} after {heads[-1]}", "position", positions)
    tables += _by_joint(results, f"Velocity error{{}} after {heads[-1]}", "velocity", velocities)
    return tables


def _torque_tables(results: Results) -> list[Table]:
    torque = results.torque
    if not torque:
        return []
    rows = {
        "mean of joints": _values(torque, lambda x: x.mean_nmse),
        "with pauses": _values(torque, lambda x: x.nmse_with_pauses),
        "worst joint": _values(torque, lambda x: max(known(x.joint_nmse), default=None)),
    }
    note = ""
    if results.torque_steps:
        note = f"logged in steps of their own size: {', '.join(results.torque_steps)}"
    rmse = _values(torque, lambda x: x.rmse)
    return [
        table("Torque error of the inverse dynamics, nMSE over all test samples", list(rows), rows.values()),
        *_by_joint(results, "Torque error by joint, RMSE{}", "torque", rmse, note),
    ]


def known(values: Iterable[float | None]) -> list[float]:
    """Return the values that are known."""
    return [value for value in values if value is not None]


def _replay_tables(results: Results) -> list[Table]:
    """Return those of commands replayed: by trajectory and by joint."""
    tables, unit = [], thousandths(results.joint_types)
    for replay in results.replays:
        rows = {}
        replayed = [errors.trajectories for errors in replay.errors.values()]
        # several runs may have replayed other logs
        for trajectory in [name for name in replayed[0] if all(name in logs for logs in replayed)]:
            rows[trajectory] = _values(replay.errors, lambda x: 1000 * x.trajectories[trajectory])  # noqa: B023
        rows["mean of all"] = _values(replay.errors, lambda x: 1000 * x.mean)
        title = f"Commands replayed, {replay.name}: RMS of positions over all joints [{unit}]"
        tables.append(table(title, list(rows), rows.values()))
        by_joint = []
        for k in range(len(results.joints)):
            by_joint.append(_values(replay.errors, lambda x: 1000 * x.joints[k]))  # noqa: B023
        if by_joint:
            title = f"The same by joint, over all trajectories [{unit}]"
            tables.append(table(title, results.joints, by_joint))
    return tables


def _by_joint(
    results: Results, title: str, quantity: str, values: Mapping[str, Sequence[float | None]], note: str = ""
) -> list[Table]:
    """Return a row for each joint; the unit stands in the title where all have the same, else beside each joint.

    There is no table where results are of several arms, which have no joints in common.
    """
    if not results.joints:
        return []
    units = [getattr(UNITS[kind], quantity) for kind in results.joint_types]
    labels = list(results.joints)
    common = ""
    if len(set(units)) == 1:
        common = f" [{units[0]}]"
    else:
        labels = [f"{joint} [{unit}]" for joint, unit in zip(labels, units, strict=True)]
    rows = [_values(values, lambda x: x[k]) for k in range(len(labels))]  # noqa: B023
    return [table(title.format(common), labels, rows, note)]
