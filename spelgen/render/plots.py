"""Panels of charts that pages draw of a run, from evaluation.json's `traces` and metrics.jsonl."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from spelgen.baselines.names import (
    CONSTANT_VELOCITY,
    LEAST_SQUARES,
    LEAST_SQUARES_WITH_MEMORY,
    MODEL,
    URDF,
    URDF_WITH_DRIVES,
    observed,
)
from spelgen.labels import UNITS, NamedJoint, entry_name
from spelgen.render.charts import MARGINS, Band, Chart, Dots, Line, Mark, Values, line_chart
from spelgen.settings.tuning.render import TUNING

Record = Mapping[str, Any]
"""A part of evaluation.json or of a trace in it."""
Limits = Sequence[tuple[float, float] | None]
"""Lowest and highest position of each joint; None: it has no limits."""

QUANTITIES = {"q": "position", "qd": "velocity"}
STYLES = {
    MODEL: "model",
    URDF: "urdf",
    URDF_WITH_DRIVES: "drives",
    LEAST_SQUARES: "squares",
    LEAST_SQUARES_WITH_MEMORY: "remembering",
    CONSTANT_VELOCITY: "hold",
    observed(MODEL): "going-on",
}
COMPONENTS = ("inertia", "Coriolis", "gravity", "friction")
ERRORS = {
    "relative": ("Relative error", "error / motion"),
    "tip_mm": ("Tip error", "tip error [mm]"),
}


@dataclass(frozen=True)
class Panel:
    """Charts that belong together: a joint's, or that of an entry of M."""

    name: str
    charts: tuple[Chart, ...]


@dataclass(frozen=True)
class Row:
    """A chart of a stack over one time; height: without the numbers of its time [pixels]."""

    lines: Sequence[Line]
    title: str
    label: str
    height: int = 130


def stack(name: str, rows: Sequence[Row], motion: str = "") -> Panel:
    """Return charts above one another; the numbers of the time stand below the last one alone."""
    charts = []
    for number, row in enumerate(rows, start=1):
        time, height = "", row.height
        if number == len(rows):
            time, height = "t [s]", row.height + MARGINS.bottom - MARGINS.bare
        charts.append(line_chart(row.lines, row.title, time, row.label, motion=motion, height=height))
    return Panel(name, tuple(charts))


def style(predictor: str) -> str:
    """Return the CSS class of a predictor's lines."""
    return STYLES.get(predictor, "c6")


def inertia_unit(a: str, b: str) -> str:
    """Return the unit of the entry of M between joints of these types."""
    if a == b:
        return UNITS[a].inertia
    return "kg m"


def numbers(values: object) -> np.ndarray:
    """Return nested lists, None where not finite, as an array."""
    return np.array(values, dtype=float)


def loss_chart(metrics: Sequence[Record], best_epoch: int) -> Chart:
    """Return training and validation loss by epoch, with the epoch of the model that was kept."""
    columns = [(record["epoch"], record["loss"], record["validation"]) for record in metrics]
    epochs, training, validation = numbers(columns).T
    lines = [
        Line("training loss", epochs, training, "train"),
        Line("validation loss", epochs, validation, "model"),
    ]
    losses = np.concatenate([training, validation])
    ends = (np.nanmin(losses), np.nanmax(losses))
    lines.append(Line("epoch of the best model", (best_epoch, best_epoch), ends, "hold"))
    return line_chart(lines, "Loss by epoch", "epoch", "loss", log=True, width=560, height=240)


@dataclass(frozen=True)
class Growth:
    """The errors of a predictor or of a run at horizons [s]: by measure low, median and high ones.

    banded: whether the range from low to high is drawn, 10 to 90 %.
    """

    name: str
    style: str
    banded: bool
    seconds: Sequence[float]
    errors: Mapping[str, Record]


def growth_panels(growths: Sequence[Growth]) -> list[Panel]:
    """Return errors against the horizon, relative and of the tip."""
    panels = []
    for measure, (title, label) in ERRORS.items():
        marks: list[Mark] = []
        errors: dict[str, Record] = {}
        for growth in growths:
            if measure not in growth.errors:
                continue
            error = errors[growth.name] = growth.errors[measure]
            marks.append(Line(growth.name, growth.seconds, numbers(error["median"]), growth.style))
            if growth.banded:
                low, high = numbers(error["low"]), numbers(error["high"])
                marks.append(Band(f"{growth.name}, 10 to 90 %", growth.seconds, low, high, growth.style))
        if marks:
            chart = line_chart(
                marks,
                f"{title}: error by horizon",
                "horizon [s]",
                label,
                log=True,
                log_x=True,
                limits=_error_limits(errors),
                width=520,
                height=260,
            )
            panels.append(Panel(title, (chart,)))
    return panels


def growth_charts(growth: Record) -> list[Panel]:
    """Return how the errors of all predictors grow with the horizon, with bands of the model and of least squares."""
    growths = []
    for name in {**growth["relative"], **growth["tip_mm"]}:
        errors = {measure: growth[measure][name] for measure in ERRORS if name in growth[measure]}
        # bands of all would hide one another
        banded = name in (MODEL, LEAST_SQUARES)
        growths.append(Growth(name, style(name), banded, growth["seconds"], errors))
    return growth_panels(growths)


def _error_limits(errors: Mapping[str, Record]) -> tuple[float, float] | None:
    """Return limits of medians and the model's band, baselines that are hopeless cut off; None without a model."""
    # pages of several runs have no baselines, and so nothing to cut off
    if MODEL not in errors:
        return None
    model_errors = _positive([errors[MODEL]["low"], errors[MODEL]["high"]])
    medians = _positive([error["median"] for error in errors.values()])
    if not model_errors.size or not medians.size:
        return None
    high = max(model_errors.max(), medians[medians < TUNING.outlier * model_errors.max()].max(initial=0.0))
    return float(min(model_errors.min(), medians.min())) / 1.3, 1.3 * float(high)


def _positive(columns: Sequence[object]) -> np.ndarray:
    values = np.concatenate(list(map(numbers, columns)))
    positive: np.ndarray = values[values > 0]
    return positive


def torque_panels(trace: Record, joints: Sequence[NamedJoint]) -> list[Panel]:
    """Return by joint measured and predicted torque, the residual, and the components of the prediction."""
    t, measured, predicted = trace["t"], numbers(trace["measured"]), numbers(trace["predicted"][MODEL])
    panels = []
    for k, joint in enumerate(joints):
        unit = joint.units.torque
        torques = [
            Line("measured", t, measured[:, k], "truth"),
            Line("predicted", t, predicted[:, k], "predicted"),
        ]
        residual = Line("residual", t, measured[:, k] - predicted[:, k], "model")
        components = []
        for name in COMPONENTS:
            components.append(Line(name, t, numbers(trace["parts"][name])[:, k], name.lower()))
        rows = [
            Row(torques, f"Torque of {joint.name}", f"torque [{unit}]", 160),
            Row([residual], f"Residual of {joint.name}", f"residual [{unit}]", 100),
            Row(components, f"Components of the torque of {joint.name}", f"components [{unit}]", 162),
        ]
        panels.append(stack(joint.name, rows, f"torque {trace['which']}"))
    return panels


def trajectory_panels(example: Record, joints: Sequence[NamedJoint]) -> list[Panel]:
    """Return by joint position and, where it is known, velocity: measured, predicted and, of servos, commanded, each
    above the difference of the first two.
    """
    t = example["t"]
    panels = []
    for k, joint in enumerate(joints):
        rows = []
        for key, quantity in QUANTITIES.items():
            if key not in example:
                continue
            measured, predicted = numbers(example[key])[:, k], numbers(example[f"predicted_{key}"])[:, k]
            lines = [Line("measured", t, measured, "truth"), Line("predicted", t, predicted, "predicted")]
            if "u" in example:
                lines.insert(0, Line("commanded", t, numbers(example["u"])[:, k], "hold"))
            title = f"{quantity} of {joint.name}"
            error = Line("error", t, predicted - measured, "model")
            rows.append(Row(lines, title, joint.axis(quantity)))
            rows.append(
                Row([error], f"Error of the {title}", joint.axis(quantity).replace(quantity, "error"), 100)
            )
        panels.append(stack(joint.name, rows, f"prediction {example['which']}"))
    return panels


def mass_panels(
    t: Values,
    entries: Mapping[tuple[int, int], Mapping[str, Values]],
    styles: Mapping[str, str],
    joint_types: Sequence[str],
    width: int = 330,
) -> list[Panel]:
    """Return entries of M, by row and column, along a trajectory: a line for each name, as the style of that name."""
    panels = []
    for (i, j), by_name in entries.items():
        name = entry_name(i, j)
        lines = [Line(label, t, numbers(values), styles[label]) for label, values in by_name.items()]
        unit = f"{name} [{inertia_unit(joint_types[i], joint_types[j])}]"
        panels.append(Panel(name, (line_chart(lines, name, "t [s]", unit, width=width),)))
    return panels


def trace_mass_panels(mass: Record, joint_types: Sequence[str]) -> list[Panel]:
    """Return the entries of M that are not zero along a trajectory, by the model and its baselines."""
    entries = {}
    # the lower triangle, row by row, as the trace lists it
    rows, columns = np.tril_indices(len(joint_types))
    largest = max(np.nanmax(np.abs(numbers(trace["entries"]))) for trace in mass["by"].values())
    for number, (i, j) in enumerate(zip(rows.tolist(), columns.tolist(), strict=True)):
        by_name = {name: numbers(trace["entries"][number]) for name, trace in mass["by"].items()}
        # rounding leaves some of what is always zero
        if any((np.abs(entry) > TUNING.zero * largest).any() for entry in by_name.values()):
            entries[i, j] = by_name
    styles = {name: style(name) for name in mass["by"]}
    return mass_panels(mass["t"], entries, styles, joint_types)


def eigenvalue_chart(mass: Record) -> Chart:
    """Return the smallest and the largest eigenvalue of M along a trajectory; what is not positive is not drawn."""
    lines = []
    for name, trace in mass["by"].items():
        for row, label in ((0, "least"), (-1, "largest")):
            eigenvalues = numbers(trace["eigenvalues"][row])
            lines.append(Line(f"{name}, {label}", mass["t"], eigenvalues, style(name)))
    return line_chart(lines, "Eigenvalues of M", "t [s]", "eigenvalue of M", log=True, width=520, height=230)


def friction_panels(friction: Record, torques: Sequence[Record], joints: Sequence[NamedJoint]) -> list[Panel]:
    """Return by joint friction by velocity, and the loops that measured motion makes of it, measured and by the model.

    Measured friction is the torque less that of the model's rigid bodies. A model whose friction has no state makes no
    loop but for load.
    """
    panels = []
    for k, joint in enumerate(joints):
        speeds, measured = [np.zeros(0)], [np.zeros(0)]
        loops: list[Mark] = []
        for trace in torques:
            speeds.append(numbers(trace["qd"])[:, k])
            modelled = numbers(trace["parts"]["friction"])[:, k]
            residual = numbers(trace["measured"])[:, k] - numbers(trace["predicted"][MODEL])[:, k]
            measured.append(modelled + residual)
            # one trajectory is enough: loops of two would cover each other
            if not loops:
                loops.append(Line("measured, over time", speeds[-1], measured[-1], "loop"))
                loops.append(Line("model, over time", speeds[-1], modelled, "loop model"))
        torque = np.concatenate(measured)
        marks: list[Mark] = [Dots("measured", np.concatenate(speeds), torque, "truth"), *loops]
        for name, curves in friction["by"].items():
            marks.append(Line(name, friction["qd"][k], numbers(curves[k]), style(name)))
        model = friction["by"].get(MODEL)
        chart = line_chart(
            marks,
            f"Friction of {joint.name}",
            joint.axis("velocity"),
            f"friction [{joint.units.torque}]",
            limits=_friction_limits(torque, numbers(model[k]) if model else np.zeros(1)),
            height=220,
        )
        panels.append(Panel(joint.name, (chart,)))
    return panels


def _friction_limits(measured: np.ndarray, curve: np.ndarray) -> tuple[float, float] | None:
    """Return limits that hold the model's curve and all but the outliers of what was measured."""
    values = np.concatenate([measured, curve])
    values = values[np.isfinite(values)]
    if not values.size:
        return None
    # samples at reversals are far off where friction was smoothed or delayed
    low, high = np.quantile(values, [1 - TUNING.bulk, TUNING.bulk])
    room = 0.15 * (high - low) or 1.0
    return float(min(low, np.nanmin(curve)) - room), float(max(high, np.nanmax(curve)) + room)


def coverage_panels(
    by_logs: Mapping[str, Record], joints: Sequence[NamedJoint], limits: Limits
) -> list[Panel]:
    """Return by joint how often positions and velocities occur in the logs named; the joint's limits are marked."""
    panels = []
    for k, joint in enumerate(joints):
        charts = []
        for key, quantity in QUANTITIES.items():
            bands = [_histogram(name, logs[key][k]) for name, logs in by_logs.items()]
            marks: list[Mark] = list(bands)
            bounds = limits[k]
            if key == "q" and bounds is not None:
                top = max(float(np.max(band.high)) for band in bands)
                low, high = bounds
                x, y = (low, low, high, high, high), (0.0, top, math.nan, 0.0, top)
                marks.append(Line("joint limits", x, y, "hold"))
            charts.append(
                line_chart(
                    marks,
                    f"{quantity} of {joint.name}",
                    joint.axis(quantity),
                    "fraction of samples",
                    width=300,
                    height=130,
                )
            )
        panels.append(Panel(joint.name, tuple(charts)))
    return panels


def _histogram(name: str, histogram: Record) -> Band:
    """Return the outline of a histogram's bars; heights sum to one."""
    counts = numbers(histogram["counts"])
    # each bar as two points, so that the outline has steps
    edges = np.linspace(histogram["low"], histogram["high"], len(counts) + 1)
    heights = np.repeat(counts / max(counts.sum(), 1.0), 2)
    style = "train" if name == "training" else "model"
    return Band(f"{name} logs", np.repeat(edges, 2)[1:-1], np.zeros_like(heights), heights, style)


def energy_chart(trace: Record) -> Chart:
    """Return the energy balance along a trajectory."""
    styles = ("truth", "urdf", "friction", "model")
    lines = []
    for (name, energy), color in zip(trace["energy"].items(), styles, strict=True):
        lines.append(Line(name, trace["t"], numbers(energy), color))
    motion = f"torque {trace['which']}"
    return line_chart(lines, "Energy", "t [s]", "energy [J]", motion=motion, width=560, height=250)
