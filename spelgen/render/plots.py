"""Panels of charts that pages draw of a run, from evaluation.json's `traces` and metrics.jsonl."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Container, Mapping, Sequence
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
from spelgen.evaluation.drawn_motions import PredictedMotion, TorqueTrace
from spelgen.evaluation.plain import array
from spelgen.evaluation.traces import FrictionTrace, Growth, Quantiles, Traces
from spelgen.evaluation.verdict import Limits
from spelgen.labels import UNITS, NamedJoint, entry_name
from spelgen.render.charts import MARGINS, Band, Chart, Dots, Line, Mark, Values, line_chart
from spelgen.render.tuning import TUNING

Record = Mapping[str, Any]
"""A record of JSON."""

QUANTITIES = {"q": "position", "qd": "velocity"}
STYLES = defaultdict(
    lambda: "c6",
    {
        MODEL: "model",
        URDF: "urdf",
        URDF_WITH_DRIVES: "drives",
        LEAST_SQUARES: "squares",
        LEAST_SQUARES_WITH_MEMORY: "remembering",
        CONSTANT_VELOCITY: "hold",
        observed(MODEL): "going-on",
    },
)
"""The CSS class of a predictor's lines."""
ERRORS = {
    "relative": ("Relative error", "error / motion"),
    "tip_mm": ("Tip error", "tip error [mm]"),
}


@dataclass(frozen=True)
class Panel:
    """Charts that belong together: a joint's, or that of an entry of M."""

    name: str
    charts: tuple[Chart, ...]


@dataclass(frozen=True, eq=False)
class JointRow:
    """A chart of each joint; unit: the quantity whose unit the axis has. columns: label, values (T, n) and style.

    height: without the numbers of the time [pixels].
    """

    title: str
    axis: str
    unit: str
    columns: Sequence[tuple[str, np.ndarray, str]]
    height: int = 130

    def chart(self, t: Values, joint: NamedJoint, k: int, time: str = "", motion: str = "") -> Chart:
        """Return that of joint k; time: label of the time, without which its numbers are left out."""
        lines = [Line(label, t, values[:, k], style) for label, values, style in self.columns]
        height = self.height + (MARGINS.bottom - MARGINS.bare if time else 0)
        title, axis = f"{self.title} of {joint.name}", f"{self.axis} [{getattr(joint.units, self.unit)}]"
        return line_chart(lines, title, time, axis, motion=motion, height=height)


def stacks(
    t: Values, rows: Sequence[JointRow], joints: Sequence[NamedJoint], motion: str = ""
) -> list[Panel]:
    """Return by joint charts above one another; the numbers of the time stand below the last one alone.

    motion: see `line_chart`.
    """
    panels = []
    for k, joint in enumerate(joints):
        charts = [row.chart(t, joint, k, motion=motion) for row in rows[:-1]]
        charts.append(rows[-1].chart(t, joint, k, "t [s]", motion))
        panels.append(Panel(joint.name, tuple(charts)))
    return panels


def loss_chart(metrics: Sequence[Record], best_epoch: int) -> Chart:
    """Return training and validation loss by epoch, with the epoch of the model that was kept."""
    columns = [(record["epoch"], record["loss"], record["validation"]) for record in metrics]
    epochs, *losses = array(columns).T
    ends = (np.nanmin(losses), np.nanmax(losses))
    lines = [
        Line("training loss", epochs, losses[0], "train"),
        Line("validation loss", epochs, losses[1], "model"),
        Line("epoch of the best model", (best_epoch, best_epoch), ends, "hold"),
    ]
    return line_chart(lines, "Loss by epoch", "epoch", "loss", log=True, width=560, height=240)


def growth_panels(
    growths: Mapping[str, tuple[Growth, str]], styles: Mapping[str, str], banded: Container[str]
) -> list[Panel]:
    """Return errors against the horizon, relative and of the tip.

    growths: by the name of a line, and which predictor of a growth it is. banded: lines with the range from 10 to 90 %.
    """
    panels = []
    for measure, (title, label) in ERRORS.items():
        marks: list[Mark] = []
        errors: dict[str, Quantiles] = {}
        for name, (growth, predictor) in growths.items():
            error = getattr(growth, measure).get(predictor)
            if error is None:
                continue
            errors[name] = error
            marks.append(Line(name, growth.seconds, error.median, styles[name]))
            if name in banded:
                marks.append(Band(f"{name}, 10 to 90 %", growth.seconds, error.low, error.high, styles[name]))
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


def _error_limits(errors: Mapping[str, Quantiles]) -> tuple[float, float] | None:
    """Return limits of medians and the model's band, baselines that are hopeless cut off; None without a model."""
    # pages of several runs have no baselines, and so nothing to cut off
    if MODEL not in errors:
        return None
    model_errors = np.concatenate([errors[MODEL].low, errors[MODEL].high])
    values = np.concatenate([model_errors, *(error.median for error in errors.values())])
    values = values[(values > 0) & (values <= TUNING.outlier * np.nanmax(model_errors))]
    if not values.size:
        return None
    return float(values.min()) / 1.3, 1.3 * float(values.max())


def torque_panels(trace: TorqueTrace, joints: Sequence[NamedJoint]) -> list[Panel]:
    """Return by joint measured and predicted torque, the residual, and the components of the prediction."""
    measured, predicted = trace.measured, trace.predicted[MODEL]
    curves = [("measured", measured, "truth"), ("predicted", predicted, "predicted")]
    components = [(name, torque, name.lower()) for name, torque in trace.parts.items()]
    rows = [
        JointRow("Torque", "torque", "torque", curves, 160),
        JointRow("Residual", "residual", "torque", [("residual", measured - predicted, "model")], 100),
        JointRow("Components of the torque", "components", "torque", components, 162),
    ]
    return stacks(trace.t, rows, joints, f"torque {trace.which}")


def trajectory_panels(
    predictions: Mapping[str, PredictedMotion],
    styles: Mapping[str, str],
    joints: Sequence[NamedJoint],
    motion: str = "",
) -> list[Panel]:
    """Return by joint position and, where it is known, velocity: measured and predicted, of servos the commands too.

    Each is above its errors. predictions: of one motion, by the names of lines, whose styles stand in `styles`.
    """
    measured = next(iter(predictions.values()))
    rows = []
    for key, quantity in QUANTITIES.items():
        values = getattr(measured, key)
        if values is None:
            continue
        lines, errors = [("measured", values, "truth")], []
        if measured.u is not None:
            lines.insert(0, ("commanded", measured.u, "hold"))
        for name, prediction in predictions.items():
            predicted = getattr(prediction, f"predicted_{key}")
            lines.append((name, predicted, styles[name]))
            errors.append((name, predicted - values, styles[name]))
        rows.append(JointRow(quantity, quantity, quantity, lines))
        rows.append(JointRow(f"Error of the {quantity}", "error", quantity, errors, 100))
    return stacks(measured.t, rows, joints, motion)


def mass_panels(
    t: Values,
    masses: Mapping[str, np.ndarray],
    styles: Mapping[str, str],
    joint_types: Sequence[str],
    width: int = 330,
) -> list[Panel]:
    """Return the entries of M that are not zero along a trajectory.

    masses: by the name of a line, the lower triangle of M, row by row, (entries, T). styles: by the same names.
    """
    panels = []
    # rounding leaves some of what is always zero
    zero = TUNING.zero * max(np.nanmax(np.abs(mass)) for mass in masses.values())
    for number, (i, j) in enumerate(np.argwhere(np.tri(len(joint_types))).tolist()):
        entries = {label: mass[number] for label, mass in masses.items()}
        if np.nanmax(np.abs(list(entries.values()))) > zero:
            lines = [Line(label, t, entry, styles[label]) for label, entry in entries.items()]
            name = entry_name(i, j)
            unit = "kg m"
            if joint_types[i] == joint_types[j]:
                unit = UNITS[joint_types[i]].inertia
            chart = line_chart(lines, name, "t [s]", f"{name} [{unit}]", width=width)
            panels.append(Panel(name, (chart,)))
    return panels


def friction_panels(
    friction: FrictionTrace, torques: Sequence[TorqueTrace], joints: Sequence[NamedJoint]
) -> list[Panel]:
    """Return by joint friction by velocity, and the loops that measured motion makes of it, measured and by the model.

    Measured friction is the torque less that of the model's rigid bodies. A model whose friction has no state makes no
    loop but for load.
    """
    panels = []
    for k, joint in enumerate(joints):
        marks: list[Mark] = []
        curve = friction.by[MODEL][k]
        values = [curve]
        for trace in torques:
            qd, modelled = trace.qd[:, k], trace.parts["friction"][:, k]
            measured = modelled + trace.measured[:, k] - trace.predicted[MODEL][:, k]
            values.append(measured)
            marks.append(Dots("measured", qd, measured, "truth"))
            # one trajectory is enough: loops of two would cover each other
            if trace is torques[0]:
                marks.append(Line("measured, over time", qd, measured, "loop"))
                marks.append(Line("model, over time", qd, modelled, "loop model"))
        for name, curves in friction.by.items():
            marks.append(Line(name, friction.qd[k], curves[k], STYLES[name]))
        chart = line_chart(
            marks,
            f"Friction of {joint.name}",
            joint.axis("velocity"),
            f"friction [{joint.units.torque}]",
            limits=_friction_limits(np.concatenate(values), curve),
            height=220,
        )
        panels.append(Panel(joint.name, (chart,)))
    return panels


def _friction_limits(values: np.ndarray, curve: np.ndarray) -> tuple[float, float] | None:
    """Return limits that hold the model's curve and all values but outliers."""
    values = values[np.isfinite(values)]
    if not values.size:
        return None
    # samples at reversals are far off where friction was smoothed or delayed
    low, high = np.quantile(values, [1 - TUNING.bulk, TUNING.bulk])
    room = 0.15 * (high - low) or 1.0
    return float(np.fmin(low, np.nanmin(curve)) - room), float(np.fmax(high, np.nanmax(curve)) + room)


def coverage_panels(
    traces: Traces, identified: Record | None, joints: Sequence[NamedJoint], limits: Limits
) -> list[Panel]:
    """Return by joint how often training and test logs have positions and velocities; the joint's limits are marked."""
    logs: dict[str, Record | None] = {"training": (identified or {}).get("coverage"), "test": traces.coverage}
    panels = []
    for k, joint in enumerate(joints):
        charts = []
        for key, quantity in QUANTITIES.items():
            bands = [_histogram(name, covered[key][k]) for name, covered in logs.items() if covered]
            if not bands:  # nor of any other joint
                return []
            marks: list[Mark] = list(bands)
            top = max(float(np.max(band.high)) for band in bands)
            if key == "q":
                for bound in limits[k] or ():
                    marks.append(Line("joint limits", (bound, bound), (0.0, top), "hold"))
            title, height = f"{quantity} of {joint.name}", 130
            label = "fraction of samples"
            charts.append(line_chart(marks, title, joint.axis(quantity), label, width=300, height=height))
        panels.append(Panel(joint.name, tuple(charts)))
    return panels


def _histogram(name: str, histogram: Record) -> Band:
    """Return the outline of a histogram's bars; heights sum to one."""
    counts = array(histogram["counts"])
    # each bar as two points, so that the outline has steps
    edges = np.linspace(histogram["low"], histogram["high"], len(counts) + 1)
    heights = np.repeat(counts / max(counts.sum(), 1.0), 2)
    style = "train" if name == "training" else "model"
    return Band(f"{name} logs", np.repeat(edges, 2)[1:-1], np.zeros_like(heights), heights, style)


def energy_chart(trace: TorqueTrace) -> Chart:
    """Return the energy balance along a trajectory."""
    styles = ("truth", "urdf", "friction", "model")
    lines = []
    for (name, energy), color in zip(trace.energy.items(), styles, strict=True):
        lines.append(Line(name, trace.t, energy, color))
    motion = f"torque {trace.which}"
    return line_chart(lines, "Energy", "t [s]", "energy [J]", motion=motion, width=560, height=250)
