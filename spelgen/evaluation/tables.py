"""Tables and figures of an evaluation, by predictor or model: for the terminal, notebooks, files and pages."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, TypeVar

from spelgen.baselines.names import LEAST_SQUARES, MODEL, URDF, observed
from spelgen.labels import UNITS, Units, share, thousandths
from spelgen.listing import Listing, number

if TYPE_CHECKING:  # `spelgen --help` lists the figures without loading torch
    from spelgen.evaluation.measurements import Measurements

OBSERVER = (
    "+ observer: with the constant disturbance that a momentum observer estimates from the 0.1 s before; "
    "all others are open-loop"
)

Numbers = Mapping[str, float | None]
"""Numbers per column; None: unknown."""
JointErrors = Sequence[float | None]
Errors = TypeVar("Errors")
Value = TypeVar("Value")
MASS_TITLE = "Error of the mass matrix, relative to the true one (at positions of the test logs)"
CSV_HEAD = ("table", "row", "predictor", "value")
PARTS = ("variance", "motion")
LIMITS = ("torque.nmse", "joint.nmse", "rollout.rms")
"""The figures that `spelgen evaluate --limit` takes."""


@dataclass(frozen=True)
class Row:
    """One quantity per column. ranked: whether the smallest number is best."""

    label: str
    values: Numbers
    ranked: bool = True

    def text(self, column: str) -> str:
        """Return the number of a column; an empty text without one."""
        return number(self.values[column]) if column in self.values else ""

    @property
    def best(self) -> list[str]:
        """Return the columns with the smallest number; [] if there is only one column."""
        if not self.ranked or len(self.values) < 2:
            return []
        smallest = min((value for value in self.values.values() if value is not None), default=None)
        return [name for name, value in self.values.items() if value is not None and value == smallest]


@dataclass(frozen=True)
class Table:
    """A row for each quantity, a column for each predictor or model. title, note: explain the numbers and the rows."""

    title: str
    rows: tuple[Row, ...]
    note: str = ""

    @property
    def columns(self) -> list[str]:
        """Return the names of all columns, in the order of the rows."""
        names: dict[str, None] = {}
        for row in self.rows:
            names |= dict.fromkeys(row.values)
        return list(names)

    def text(self) -> str:
        """Return the table for a terminal; the best of each row is starred."""
        return self.listing().text()

    def listing(self) -> Listing:
        """Return the table with numbers as text."""
        lines, columns = [], self.columns
        for row in self.rows:
            texts, best = [row.label], row.best
            for name in columns:
                texts.append(f"{row.text(name)} {'*' if name in best else ' '}")
            lines.append(tuple(texts))
        head = ("", *(f"{name}  " for name in columns))
        return Listing(self.title, head, tuple(lines), self.note)


def table(title: str, rows: Mapping[str, Numbers], note: str = "") -> Table:
    """Return a table of ranked rows, by label and column."""
    return Table(title, tuple(map(Row, rows, rows.values())), note)


def result_tables(results: Measurements) -> list[Table]:
    """Return the tables of an evaluation: replays, errors per horizon and per joint, torques."""
    tables = [*_replay_tables(results), *_horizon_tables(results), *_torque_tables(results)]
    if results.mass_errors:
        tables.append(table(MASS_TITLE, {"M(q)": results.mass_errors}))
    return list(map(_without_empty_baselines, tables))


def _without_empty_baselines(full: Table) -> Table:
    """Return the table without columns of baselines that have no number."""
    columns = {MODEL}
    for row in full.rows:
        columns |= {name for name, value in row.values.items() if value is not None}
    rows = []
    for row in full.rows:
        rows.append(replace(row, values={name: row.values[name] for name in row.values if name in columns}))
    return replace(full, rows=tuple(rows))


def joined(runs: Mapping[str, Measurements]) -> list[Table]:
    """Return the tables and rows that all runs have, with a column for the model of each run."""
    rows: dict[str, dict[str, dict[str, float | None]]] = {}
    for run, results in runs.items():
        for one_table in result_tables(results):
            by_label = rows.setdefault(one_table.title, {})
            for row in one_table.rows:
                by_label.setdefault(row.label, {})[run] = row.values[MODEL]
    tables = []
    for title, by_label in rows.items():
        common = {label: values for label, values in by_label.items() if len(values) == len(runs)}
        if common:
            tables.append(table(title, common))
    return tables


def csv_text(results: Measurements) -> str:
    """Return the numbers of all tables as CSV, a line for each; unknown values are empty."""
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(CSV_HEAD)
    for one_table in result_tables(results):
        for row in one_table.rows:
            for predictor, value in row.values.items():
                writer.writerow((one_table.title, row.label, predictor, value))
    return file.getvalue()


def summary(results: Measurements) -> Listing | None:
    """Return the figures of URDF, least squares and model in one small table; None without torques."""
    rows: dict[str, Numbers] = {"torque that is unexplained": _values(results.torque, lambda x: x.mean_nmse)}
    if results.mass_errors:
        rows["error of M(q)"] = results.mass_errors
    names = [name for name in (URDF, LEAST_SQUARES, MODEL) if name in results.torque]
    if MODEL not in names:
        return None
    lines = []
    for label, values in rows.items():
        numbers = [values.get(name) for name in names]
        lines.append((label, *("-" if value is None else share(value) for value in numbers)))
    return Listing(f"{results.robot} on the test logs", ("", *names), tuple(lines))


def _values(errors: Mapping[str, Errors], value: Callable[[Errors], Value]) -> dict[str, Value]:
    """Return a value of the errors of each predictor."""
    return {predictor: value(of_predictor) for predictor, of_predictor in errors.items()}


def _horizon_tables(results: Measurements) -> list[Table]:
    if not results.horizons:
        return []
    relative, tips = {}, {}
    for horizon in results.horizons:
        head = horizon.name
        if not head.endswith(" s"):
            head = f"{head} ({horizon.seconds:.3g} s)"
        relative[head] = _values(horizon.errors, lambda x: x.mean_relative_rms)
        tips[head] = _values(horizon.errors, lambda x: x.tip_mm)
    errors = results.horizons[-1].errors
    note = OBSERVER if any(observed(MODEL) in horizon.errors for horizon in results.horizons) else ""
    tables = [
        table("Error relative to the motion (0: none, 1: as if the arm had stood still)", relative, note),
        table("Error of the tip's position [mm]", tips),
        _by_joint(
            results, f"Position error{{}} after {head}", lambda x: x.position, _values(errors, lambda x: x.q)
        ),
        _by_joint(
            results, f"Velocity error{{}} after {head}", lambda x: x.velocity, _values(errors, lambda x: x.qd)
        ),
    ]
    # no tip is known without a URDF
    if all(value is None for row in tips.values() for value in row.values()):
        del tables[1]
    return tables


def _torque_tables(results: Measurements) -> list[Table]:
    torque = results.torque
    if not torque:
        return []
    rows = {
        "mean of joints": _values(torque, lambda x: x.mean_nmse),
        "with pauses": _values(torque, lambda x: x.nmse_with_pauses),
        "worst joint": _values(torque, lambda x: x.worst_nmse),
    }
    note = ""
    if results.torque_steps:
        note = f"logged in steps of their own size: {', '.join(results.torque_steps)}"
    return [
        table("Torque error of the inverse dynamics, nMSE over all test samples", rows),
        _by_joint(
            results,
            "Torque error by joint, RMSE{}",
            lambda x: x.torque,
            _values(torque, lambda x: x.rmse),
            note,
        ),
    ]


def _replay_tables(results: Measurements) -> list[Table]:
    """Return the tables of replayed commands: per trajectory and per joint."""
    tables, unit = [], thousandths(results.joint_types)
    for replay in results.replays:
        rows: dict[str, Numbers] = {}
        for log in replay.errors[MODEL].trajectories:
            rows[log] = {name: 1000 * errors.trajectories[log] for name, errors in replay.errors.items()}
        means, joints = {}, {}
        for name, errors in replay.errors.items():
            means[name] = 1000 * errors.mean
            joints[name] = [1000 * rms for rms in errors.joints]
        rows["mean of all"] = means
        title = f"Commands replayed, {replay.name}: RMS"
        tables.append(table(f"{title} of positions over all joints [{unit}]", rows))
        title = f"{title} by joint, over all trajectories [{unit}]"
        tables.append(table(title, _joint_rows(results.joints, joints)))
    return tables


def _by_joint(
    results: Measurements,
    title: str,
    unit_of: Callable[[Units], str],
    errors: Mapping[str, JointErrors],
    note: str = "",
) -> Table:
    """Return a table with a row for each joint; the unit is in the title if all joints have the same."""
    units = [unit_of(UNITS[joint_type]) for joint_type in results.joint_types]
    if len(set(units)) == 1:
        return table(title.format(f" [{units[0]}]"), _joint_rows(results.joints, errors), note)
    labels = [f"{joint} [{unit}]" for joint, unit in zip(results.joints, units, strict=True)]
    return table(title.format(""), _joint_rows(labels, errors), note)


def _joint_rows(labels: Sequence[str], errors: Mapping[str, JointErrors]) -> dict[str, Numbers]:
    """Return the errors of all predictors per joint."""
    rows: dict[str, Numbers] = {}
    for k, label in enumerate(labels):
        rows[label] = {name: values[k] for name, values in errors.items()}
    return rows


@dataclass(frozen=True)
class Figure:
    """One of the few figures that summarise an evaluation. unit: "variance" and "motion" mean a fraction of these."""

    name: str
    label: str
    unit: str
    value: float

    def text(self) -> str:
        """Return the value with its unit."""
        if self.unit in PARTS:
            return share(self.value, self.unit)
        return f"{number(self.value)} {self.unit}"


def figures(results: Measurements) -> list[Figure]:
    """Return the known figures of the model: nMSE of torques, errors of the longest rollout and of replays."""
    candidates: list[tuple[str, str, str, float | None]] = []
    if MODEL in results.torque:
        torque = results.torque[MODEL]
        candidates += [
            ("torque.nmse", "nMSE of torques", "variance", torque.mean_nmse),
            ("joint.nmse", "nMSE of the worst joint's torque", "variance", torque.worst_nmse),
        ]
    # the longest horizon is the hardest, and the relevant one for simulation
    for horizon in results.horizons[-1:]:
        errors = horizon.errors[MODEL]
        candidates += [
            ("rollout.rms", f"rollout error after {horizon.name}", "motion", errors.mean_relative_rms),
            ("tip.mm", f"tip error after {horizon.name}", "mm", errors.tip_mm),
        ]
    for replay in results.replays:
        label = f"position error, commands replayed, {replay.name}"
        mean = 1000 * replay.errors[MODEL].mean
        candidates.append(("replay", label, thousandths(results.joint_types), mean))
    figures = []
    for name, label, unit, value in candidates:
        if value is not None:
            figures.append(Figure(name, label, unit, value))
    return figures
