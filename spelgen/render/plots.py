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
from spelgen.labels import entry_name
from spelgen.render.charts import Band, Chart, Dots, Line, Mark, Values, line_chart
from spelgen.settings.tuning.render import TUNING

Record = Mapping[str, Any]
"""A part of evaluation.json or of a trace in it."""
Limits = Sequence[tuple[float, float] | None]
"""Lowest and highest position of each joint; None: it has no limits."""

UNITS = {"revolute": ("rad", "rad/s"), "prismatic": ("m", "m/s")}
FORCE = {"revolute": "Nm", "prismatic": "N"}
INERTIA_UNITS = {"revolute revolute": "kg m²", "prismatic prismatic": "kg"}
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


def style(predictor: str) -> str:
    """Return the CSS class of a predictor's lines."""
    return STYLES.get(predictor, "c6")


def inertia_unit(a: str, b: str) -> str:
    """Return the unit of the entry of M between joints of these types."""
    return INERTIA_UNITS.get(f"{a} {b}", "kg m")


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


def growth_panels(
    curves: Mapping[str, Mapping[str, tuple[Sequence[float], Record]]],
    styles: Mapping[str, str],
    banded: Sequence[str],
) -> list[Panel]:
    """Return errors against the horizon [s], relative and of the tip: medians, and of the banded names 10 to 90 %.

    curves: by measure and name the horizons, and low, median and high error at each.
    """
    panels = []
    for measure, (title, label) in ERRORS.items():
        marks: list[Mark] = []
        for name, (seconds, error) in curves.get(measure, {}).items():
            marks.append(Line(name, seconds, numbers(error["median"]), styles[name]))
            if name in banded:
                low, high = numbers(error["low"]), numbers(error["high"])
                marks.append(Band(f"{name}, 10 to 90 %", seconds, low, high, styles[name]))
        if marks:
            chart = line_chart(
                marks,
                f"{title}: error by horizon",
                "horizon [s]",
                label,
                log=True,
                log_x=True,
                limits=_error_limits(curves[measure]),
                width=520,
                height=260,
            )
            panels.append(Panel(title, (chart,)))
    return panels


def growth_charts(growth: Record) -> list[Panel]:
    """Return how the errors of all predictors grow with the horizon, with bands of the model and of least squares."""
    curves = {}
    for measure in ERRORS:
        curves[measure] = {name: (growth["seconds"], error) for name, error in growth[measure].items()}
    styles = {name: style(name) for name in {**growth["relative"], **growth["tip_mm"]}}
    return growth_panels(curves, styles, (MODEL, LEAST_SQUARES))  # bands of all would hide one another


def _error_limits(errors: Mapping[str, tuple[Sequence[float], Record]]) -> tuple[float, float] | None:
    """Return limits of medians and the model's band, baselines that are hopeless cut off; None without a model."""
    # pages of several runs have no baselines, and so nothing to cut off
    if MODEL not in errors:
        return None
    model_errors = _positive([errors[MODEL][1][key] for key in ("low", "high")])
    medians = _positive([error["median"] for _, error in errors.values()])
    if not model_errors.size or not medians.size:
        return None
    high = max(model_errors.max(), medians[medians < TUNING.outlier * model_errors.max()].max(initial=0.0))
    return float(min(model_errors.min(), medians.min())) / 1.3, 1.3 * float(high)


def _positive(columns: Sequence[object]) -> np.ndarray:
    values = np.concatenate([numbers(column) for column in columns])
    positive: np.ndarray = values[values > 0]
    return positive


def torque_panels(trace: Record, joints: Sequence[str], joint_types: Sequence[str]) -> list[Panel]:
    """Return by joint measured and predicted torque, the residual, and the components of the prediction."""
    t, measured, motion = trace["t"], numbers(trace["measured"]), f"torque {trace['which']}"
    predicted = numbers(trace["predicted"][MODEL])
    components = {name: numbers(trace["parts"][name]) for name in COMPONENTS}
    panels = []
    for k, (joint, kind) in enumerate(zip(joints, joint_types, strict=True)):
        unit = FORCE[kind]
        torques = [
            Line("measured", t, measured[:, k], "truth"),
            Line("predicted", t, predicted[:, k], "predicted"),
        ]
        residual = [Line("residual", t, measured[:, k] - predicted[:, k], "model")]
        lines = [Line(name, t, torque[:, k], name.lower()) for name, torque in components.items()]
        charts = (
            line_chart(torques, f"Torque of {joint}", "", f"torque [{unit}]", motion=motion, height=160),
            line_chart(residual, f"Residual of {joint}", "", f"residual [{unit}]", motion=motion, height=100),
            line_chart(
                lines, f"Components of the torque of {joint}", "t [s]", f"components [{unit}]", motion=motion
            ),
        )
        panels.append(Panel(joint, charts))
    return panels


def trajectory_panels(example: Record, joints: Sequence[str], joint_types: Sequence[str]) -> list[Panel]:
    """Return by joint position and, where it is known, velocity: measured, predicted and, of servos, commanded, each
    above the difference of the first two.
    """
    t, motion = example["t"], f"prediction {example['which']}"
    keys = [key for key in QUANTITIES if key in example]
    panels = []
    for k, (joint, kind) in enumerate(zip(joints, joint_types, strict=True)):
        charts = []
        for key, unit in zip(keys, UNITS[kind], strict=False):
            quantity = QUANTITIES[key]
            measured, predicted = numbers(example[key])[:, k], numbers(example[f"predicted_{key}"])[:, k]
            lines = [Line("measured", t, measured, "truth"), Line("predicted", t, predicted, "predicted")]
            if "u" in example:
                lines.insert(0, Line("commanded", t, numbers(example["u"])[:, k], "hold"))
            error = [Line("error", t, predicted - measured, "model")]
            title, label, height = f"{quantity} of {joint}", "", 100
            if key == keys[-1]:  # the time stands below the last chart alone
                label, height = "t [s]", 128
            charts.append(line_chart(lines, title, "", f"{quantity} [{unit}]", motion=motion, height=130))
            charts.append(
                line_chart(
                    error, f"Error of the {title}", label, f"error [{unit}]", motion=motion, height=height
                )
            )
        panels.append(Panel(joint, tuple(charts)))
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


def trace_mass_panels(
    mass: Record, kinds: Sequence[Sequence[str]], joint_types: Sequence[str]
) -> list[Panel]:
    """Return the entries of M that are not always zero, by the model and its baselines. kinds: of each entry."""
    entries = {}
    # the lower triangle, row by row, as the trace lists it
    rows, columns = np.tril_indices(len(joint_types))
    for number, (i, j) in enumerate(zip(rows.tolist(), columns.tolist(), strict=True)):
        if kinds[i][j] != "zero":
            entries[i, j] = {name: x["entries"][number] for name, x in mass["by"].items()}
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


def friction_panels(
    friction: Record, torques: Sequence[Record], joints: Sequence[str], joint_types: Sequence[str]
) -> list[Panel]:
    """Return by joint friction by velocity, and the loops that measured motion makes of it, measured and by the model.

    Measured friction is the torque less that of the model's rigid bodies. A model whose friction has no state makes no
    loop but for load.
    """
    panels = []
    for k, (joint, kind) in enumerate(zip(joints, joint_types, strict=True)):
        dots = friction["measured"][k]
        marks: list[Mark] = [Dots("measured", numbers(dots["qd"]), numbers(dots["torque"]), "truth")]
        # one trajectory is enough: loops of two would cover each other
        for trace in torques[:1]:
            qd = numbers(trace["qd"])[:, k]
            measured = numbers(trace["measured"])[:, k] - numbers(trace["without_friction"])[:, k]
            modelled = numbers(trace["parts"]["friction"])[:, k]
            marks.append(Line("measured, over time", qd, measured, "loop"))
            marks.append(Line("model, over time", qd, modelled, "loop model"))
        for name, curves in friction["by"].items():
            marks.append(Line(name, friction["qd"][k], numbers(curves[k]), style(name)))
        model = friction["by"].get(MODEL)
        chart = line_chart(
            marks,
            f"Friction of {joint}",
            f"velocity [{UNITS[kind][1]}]",
            f"friction [{FORCE[kind]}]",
            limits=_friction_limits(numbers(dots["torque"]), numbers(model[k]) if model else np.zeros(1)),
            height=220,
        )
        panels.append(Panel(joint, (chart,)))
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
    by_logs: Mapping[str, Record], joints: Sequence[str], joint_types: Sequence[str], limits: Limits
) -> list[Panel]:
    """Return by joint how often positions and velocities occur in the logs named; the joint's limits are marked."""
    panels = []
    for k, (joint, kind) in enumerate(zip(joints, joint_types, strict=True)):
        charts = []
        for (key, quantity), unit in zip(QUANTITIES.items(), UNITS[kind], strict=True):
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
                    f"{quantity} of {joint}",
                    f"{quantity} [{unit}]",
                    "fraction of samples",
                    width=300,
                    height=130,
                )
            )
        panels.append(Panel(joint, tuple(charts)))
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
