"""Tables and figures of results, by predictor or model: for the terminal, notebooks, files and pages."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from spelgen.baselines.names import MODEL, observed
from spelgen.labels import UNITS, share, thousandths
from spelgen.listing import Listing, number

if TYPE_CHECKING:
    from spelgen.evaluation.results import Results

OBSERVER = (
    "+ observer: with the constant disturbance that a momentum observer estimates from the 0.1 s before; "
    "all others are open-loop"
)

Numbers = Mapping[str, float | None]
"""By column; None where a number is not known."""
CSV_HEAD = ("table", "row", "predictor", "value")
PARTS = ("variance", "motion")
LIMITS = ("torque.nmse", "joint.nmse", "rollout.rms")
"""The figures that `spelgen evaluate --limit` takes."""


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


def joined(runs: Mapping[str, Results]) -> list[Table]:
    """Return the tables and rows that all runs have, with a column for each run: that of its model."""
    rows: dict[str, dict[str, dict[str, float | None]]] = {}
    for run, results in runs.items():
        for one_table in result_tables(results):
            for row in one_table.rows:
                if MODEL in row.values:
                    by_label = rows.setdefault(one_table.title, {})
                    by_label.setdefault(row.label, {})[run] = row.values[MODEL]
    tables = []
    for title, by_label in rows.items():
        common = {label: values for label, values in by_label.items() if len(values) == len(runs)}
        if common:
            tables.append(table(title, list(common), common.values()))
    return tables


def csv_text(results: Results) -> str:
    """Return the numbers of all tables as one, a row for each; an empty value stands for one that is not known."""
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(CSV_HEAD)
    for one_table in result_tables(results):
        for row in one_table.rows:
            for predictor, value in row.values.items():
                writer.writerow((one_table.title, row.label, predictor, value))
    return file.getvalue()


def _values(errors: Mapping[str, object], name: str) -> dict[str, float | None]:
    """Return one number of the errors of each predictor."""
    return {predictor: getattr(of_predictor, name) for predictor, of_predictor in errors.items()}


def known(values: Iterable[float | None]) -> list[float]:
    """Return the values that are known."""
    return [value for value in values if value is not None]


def _horizon_tables(results: Results) -> list[Table]:
    if not results.horizons:
        return []
    heads, relative, tips, note = [], [], [], ""
    for horizon in results.horizons:
        head = horizon.name
        if not head.endswith(" s"):
            head = f"{head} ({horizon.seconds:.3g} s)"
        heads.append(head)
        relative.append(_values(horizon.errors, "mean_relative_rms"))
        tips.append(_values(horizon.errors, "tip_mm"))
        if observed(MODEL) in horizon.errors:
            note = OBSERVER
    title = "Error relative to the motion (0: none, 1: as if the arm had stood still)"
    tables = [table(title, heads, relative, note)]
    # no tip is known without a URDF
    if any(known(row.values()) for row in tips):
        tables.append(table("Error of the tip's position [mm]", heads, tips))
    last = results.horizons[-1].errors
    return [
        *tables,
        *_by_joint(results, f"Position error{{}} after {heads[-1]}", "position", last, "q"),
        *_by_joint(results, f"Velocity error{{}} after {heads[-1]}", "velocity", last, "qd"),
    ]


def _torque_tables(results: Results) -> list[Table]:
    torque = results.torque
    if not torque:
        return []
    rows = {
        "mean of joints": _values(torque, "mean_nmse"),
        "with pauses": _values(torque, "nmse_with_pauses"),
        "worst joint": _values(torque, "worst_nmse"),
    }
    note = ""
    if results.torque_steps:
        note = f"logged in steps of their own size: {', '.join(results.torque_steps)}"
    return [
        table("Torque error of the inverse dynamics, nMSE over all test samples", list(rows), rows.values()),
        *_by_joint(results, "Torque error by joint, RMSE{}", "torque", torque, "rmse", note),
    ]


def _replay_tables(results: Results) -> list[Table]:
    """Return those of commands replayed: by trajectory and by joint."""
    tables, unit = [], thousandths(results.joint_types)
    for replay in results.replays:
        rows: dict[str, dict[str, float | None]] = {}
        joints: dict[str, dict[str, float | None]] = {}
        for predictor, errors in replay.errors.items():
            for name, rms in [*errors.trajectories.items(), ("mean of all", errors.mean)]:
                rows.setdefault(name, {})[predictor] = 1000 * rms
            for name, rms in zip(results.joints, errors.joints, strict=True):
                joints.setdefault(name, {})[predictor] = 1000 * rms
        title = f"Commands replayed, {replay.name}: RMS of positions over all joints [{unit}]"
        tables.append(table(title, list(rows), rows.values()))
        title = f"Commands replayed, {replay.name}: RMS by joint, over all trajectories [{unit}]"
        tables.append(table(title, list(joints), joints.values()))
    return tables


def _by_joint(
    results: Results, title: str, quantity: str, errors: Mapping[str, object], name: str, note: str = ""
) -> list[Table]:
    """Return a row for each joint; the unit stands in the title where all have the same, else beside each joint.

    name: of the field of the predictors' errors.
    """
    units = [getattr(UNITS[kind], quantity) for kind in results.joint_types]
    labels = list(results.joints)
    common = ""
    if len(set(units)) == 1:
        common = f" [{units[0]}]"
    else:
        labels = [f"{joint} [{unit}]" for joint, unit in zip(labels, units, strict=True)]
    rows = []
    for k in range(len(labels)):
        rows.append({predictor: getattr(errors[predictor], name)[k] for predictor in errors})
    return [table(title.format(common), labels, rows, note)]


@dataclass(frozen=True)
class Figure:
    """One of the few figures that sum an evaluation up, of each predictor; unit: "variance" and "motion" are parts."""

    name: str
    label: str
    unit: str
    values: Numbers

    def text(self, value: float) -> str:
        """Return a value with its unit."""
        if self.unit in PARTS:
            return share(value, self.unit)
        return f"{number(value)} {self.unit}"


def figures(results: Results) -> list[Figure]:
    """Return nMSE of torques, errors after the longest rollout, and those with commands replayed."""
    found = []
    torque = results.torque
    if torque:
        found.append(Figure("torque.nmse", "nMSE of torques", "variance", _values(torque, "mean_nmse")))
        worst = _values(torque, "worst_nmse")
        found.append(Figure("joint.nmse", "nMSE of the worst joint's torque", "variance", worst))
    # the longest horizon is the hardest, and what a simulation needs
    for horizon in results.horizons[-1:]:
        relative = _values(horizon.errors, "mean_relative_rms")
        found.append(Figure("rollout.rms", f"rollout error after {horizon.name}", "motion", relative))
        tips = _values(horizon.errors, "tip_mm")
        found.append(Figure("tip.mm", f"tip error after {horizon.name}", "mm", tips))
    for replay in results.replays:
        means = {name: 1000 * errors.mean for name, errors in replay.errors.items()}
        label = f"position error, commands replayed, {replay.name}"
        found.append(Figure("replay", label, thousandths(results.joint_types), means))
    return found
