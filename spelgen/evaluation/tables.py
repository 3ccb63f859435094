"""Tables of an evaluation, with a column per predictor: for the terminal, notebooks and pages."""

from __future__ import annotations

from collections.abc import Container, Mapping, Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING

from spelgen.labels import LEAST_SQUARES, MODEL, UNITS, URDF, observed, share, thousandths
from spelgen.listing import Listing, number

# `spelgen --help` imports this module for LIMITS. An import of the results would also load torch.
if TYPE_CHECKING:
    from spelgen.evaluation.results import Results

OBSERVER = (
    "+ observer: with the constant disturbance that a momentum observer estimates from the 0.1 s before; "
    "all others are open-loop"
)

Numbers = Mapping[str, float | None]
"""Numbers of a row, by the name of the column; None for an unknown number."""
MASS_TITLE = "Error of the mass matrix, relative to the true one (at positions of the test logs)"
LIMITS = ("torque.nmse", "joint.nmse", "rollout.rms")
"""Names of the figures that `spelgen evaluate --limit` accepts."""


def table(title: str, rows: Mapping[str, Numbers], note: str = "", unranked: Container[str] = ()) -> Listing:
    """Return a table of numbers with a row per quantity; a star marks the smallest number of a row.

    Args:
        title: title that states the quantity and unit of the numbers.
        rows: {label of a row: {name of a column, such as a predictor: number}}.
        note: explanation of the rows, below the table.
        unranked: labels of the rows without a star, because the smallest number is not the best.
    """
    columns = list(dict.fromkeys(name for row in rows.values() for name in row))
    lines = []
    for label, row in rows.items():
        best = min((value for value in row.values() if value is not None), default=None)
        # A row of one number has no star: there is nothing to compare it with.
        if label in unranked or len(row) < 2:
            best = None
        cells = [label]
        for name in columns:
            star = "*" if best is not None and row.get(name) == best else " "
            # Numbers without a star end with a blank, so that the digits of a column are aligned.
            cells.append(f"{number(row[name]) if name in row else ''} {star}")
        lines.append(cells)
    # The blanks in place of stars are removed from columns without any star, so that the table has more room for names
    # of joints.
    padded = zip(["", *(f"{name}  " for name in columns)], *lines, strict=True)
    starred = [x if any(cell.endswith("*") for cell in x) else tuple(map(str.rstrip, x)) for x in padded]
    head, *body = zip(*starred, strict=True)
    return Listing(title, head, tuple(body), note)


def result_tables(results: Results) -> list[Listing]:
    """Return the tables of an evaluation: errors of replayed logs, of predictions per horizon, of torques, and of M."""
    tables = [*_replay_tables(results), *_horizon_tables(results), *_torque_tables(results)]
    if results.mass_errors:
        tables.append(_predictor_table(MASS_TITLE, {"M(q)": results.mass_errors}))
    return tables


def _predictor_table(title: str, rows: Mapping[str, Numbers], note: str = "") -> Listing:
    """Return a table of the model and the baselines, without the baselines that have no number in any row."""
    # The column of the model is kept even without numbers: it shows that the model has no result.
    columns = {MODEL}.union(*({name for name in row if row[name] is not None} for row in rows.values()))
    numbers = {label: {name: row[name] for name in row if name in columns} for label, row in rows.items()}
    return table(title, numbers, note)


def summary(results: Results) -> Listing | None:
    """Return a small table that compares the URDF, least squares and the model; None without torque errors.

    Its rows are the unexplained fraction of the torque variance and, if the true M is known, the error of M.
    """
    if MODEL not in results.torque:
        return None
    errors = {name: x.mean_nmse for name, x in results.torque.items()}
    rows: dict[str, Numbers] = {"torque that is unexplained": errors, "error of M(q)": results.mass_errors}
    # The columns show the improvement from the URDF to least squares on logs, and to the trained model.
    names = [name for name in (URDF, LEAST_SQUARES, MODEL) if name in errors]
    lines = []
    for label, values in rows.items():
        numbers = [values.get(name) for name in names]
        # The row of the mass matrix M is shown only if the true M is known.
        if values:
            lines.append((label, *("-" if value is None else share(value) for value in numbers)))
    return Listing(f"{results.robot} on the test logs", ("", *names), lines)


def _horizon_tables(results: Results) -> list[Listing]:
    """Return tables of the prediction errors per horizon, and of the errors per joint at the last horizon."""
    if not results.horizons:
        return []
    relative, tips, note, diverged = {}, {}, "", ""
    for horizon in results.horizons:
        head = horizon.name
        if not head.endswith(" s"):
            head = f"{head} ({horizon.seconds:.3g} s)"
        relative[head] = {name: errors.mean_relative_rms for name, errors in horizon.errors.items()}
        tips[head] = {name: errors.tip_mm for name, errors in horizon.errors.items()}
        # The note explains the observer. It is omitted if the logs are too short for predictions with an observer.
        if observed(MODEL) in horizon.errors:
            note = OBSERVER
        if any(error is None for error in relative[head].values()):
            diverged = "-: not finite, since a prediction diverged"
    q = {name: errors.q for name, errors in horizon.errors.items()}
    qd = {name: errors.qd for name, errors in horizon.errors.items()}
    title = "Error relative to the motion (0: none, 1: as if the arm had stood still)"
    tables = [_predictor_table(title, relative, "; ".join(filter(None, [note, diverged])))]
    # Without a URDF the tip is unknown, and the table of tip errors is omitted.
    if any(value is not None for row in tips.values() for value in row.values()):
        tables.append(_predictor_table("Error of the tip's position [mm]", tips))
    tables.append(_by_joint(results, f"Position error{{}} after {head}", "position", q))
    return [*tables, _by_joint(results, f"Velocity error{{}} after {head}", "velocity", qd)]


def _torque_tables(results: Results) -> list[Listing]:
    """Return tables of the nMSE of the torques, and of the torque errors per joint."""
    if not results.torque:
        return []
    rows = {
        "mean of joints": {name: errors.mean_nmse for name, errors in results.torque.items()},
        "with pauses": {name: errors.nmse_with_pauses for name, errors in results.torque.items()},
        "worst joint": {name: errors.worst_nmse for name, errors in results.torque.items()},
    }
    rmse = {name: errors.rmse for name, errors in results.torque.items()}
    steps = ", ".join(results.torque_steps)
    note = f"logged in steps of their own size: {steps}" if steps else ""
    title = "Torque error of the inverse dynamics, nMSE over all test samples"
    by_joint = _by_joint(results, "Torque error by joint, RMSE{}", "torque", rmse, note)
    return [_predictor_table(title, rows), by_joint]


def _replay_tables(results: Results) -> list[Listing]:
    """Return the tables of position errors under replayed commands: per trajectory and per joint."""
    tables, unit = [], thousandths(results.joint_types)
    for replay in results.replays:
        rows = {}
        for log in replay.errors[MODEL].trajectories:
            rows[log] = {name: 1000 * errors.trajectories[log] for name, errors in replay.errors.items()}
        # The mean of all logs is the last row of the table.
        rows["mean of all"] = {name: 1000 * errors.mean for name, errors in replay.errors.items()}
        joints = {name: [1000 * rms for rms in errors.joints] for name, errors in replay.errors.items()}
        title = f"Commands replayed, {replay.name}: RMS"
        tables.append(_predictor_table(f"{title} of positions over all joints [{unit}]", rows))
        title = f"{title} by joint, over all trajectories [{unit}]"
        tables.append(_predictor_table(title, _joint_rows(results.joints, joints)))
    return tables


def _by_joint(
    results: Results, title: str, quantity: str, errors: Mapping[str, Sequence[float | None]], note: str = ""
) -> Listing:
    """Return a table of the errors of all predictors, with one row per joint.

    Args:
        results: the evaluation, for the names and types of the joints.
        title: title with the placeholder {} for the unit.
        quantity: "position", "velocity" or "torque", which determines the unit.
        errors: {predictor: errors of all joints}.
        note: explanation below the table.
    """
    units = [asdict(UNITS[joint_type])[quantity] for joint_type in results.joint_types]
    # If all joints have the same unit, it is in the title: a unit in each row would widen the first column.
    labels, common = results.joints, f" [{units[0]}]"
    if len(set(units)) > 1:
        pairs = zip(results.joints, units, strict=True)
        labels, common = tuple(f"{joint} [{unit}]" for joint, unit in pairs), ""
    return _predictor_table(title.format(common), _joint_rows(labels, errors), note)


def _joint_rows(labels: Sequence[str], errors: Mapping[str, Sequence[float | None]]) -> dict[str, Numbers]:
    """Return {label of a joint: {predictor: error}}. errors: {predictor: errors of all joints}."""
    return {label: {name: values[k] for name, values in errors.items()} for k, label in enumerate(labels)}


def limit_figures(results: Results) -> dict[str, float | None]:
    """Return the figures of the model that the option --limit tests, {name in `LIMITS`: figure}; None if unknown.

    The relative error of a rollout is the error at the longest horizon, which is the most difficult one.
    """
    values: dict[str, float | None] = dict.fromkeys(LIMITS)
    if MODEL in results.torque:
        torque = results.torque[MODEL]
        values |= {"torque.nmse": torque.mean_nmse, "joint.nmse": torque.worst_nmse}
    for horizon in results.horizons[-1:]:
        values["rollout.rms"] = horizon.errors[MODEL].mean_relative_rms
    return values
