"""Groups of charts that several pages show: quantities per joint, prediction errors, entries of M."""

from collections import defaultdict
from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from spelgen import labels
from spelgen.evaluation.drawn_motions import PredictedMotion
from spelgen.evaluation.traces import Growth, Quantiles
from spelgen.render.charts import MARGINS, TUNING, Band, Chart, Line, Mark, Values, line_chart

STYLES = defaultdict(
    lambda: "c6",
    {
        labels.MODEL: "model",
        labels.URDF: "urdf",
        labels.URDF_WITH_DRIVES: "drives",
        labels.LEAST_SQUARES: "squares",
        labels.LEAST_SQUARES_WITH_MEMORY: "remembering",
        labels.CONSTANT_VELOCITY: "hold",
        labels.observed(labels.MODEL): "going-on",
    },
)
"""Predictor -> CSS class of its lines."""
MEASURES: tuple[tuple[str, str, Callable[[Growth], Mapping[str, Quantiles]]], ...] = (
    ("Relative error", "error / motion", lambda growth: growth.relative),
    ("Tip error", "tip error [mm]", lambda growth: growth.tip_mm),
)


@dataclass(frozen=True)
class Panel:
    """A group of charts with a common title, for example the charts of one joint."""

    name: str
    charts: tuple[Chart, ...]


@dataclass(frozen=True, eq=False)
class JointRow:
    """A row of charts, one per joint.

    Attributes:
        title: Title of the charts, without the name of the joint.
        axis: Label of the y axis.
        quantity: "position", "velocity" or "torque", which determines the unit of the y axis; "": no unit is shown.
        columns: Label, values (T, n) and CSS class of each curve. The chart of joint k shows column k of the values.
        height: Height of a chart without the numbers of its time axis [pixels].
    """

    title: str
    axis: str
    quantity: str
    columns: Sequence[tuple[str, np.ndarray, str]]
    height: int = 130


def stacks(
    t: Values, rows: Sequence[JointRow], joints: Sequence[labels.NamedJoint], motion: str = ""
) -> list[Panel]:
    """Return a column of charts per joint; only the last chart has the numbers of the common time axis.

    Args:
        t: Times, (T,) [s].
        rows: The charts of a column, from top to bottom.
        joints: Names and units of the joints.
        motion: Name of the animated motion with the same time axis.
    """
    panels = []
    for k, joint in enumerate(joints):
        charts = []
        for row in rows:
            lines = [Line(label, t, values[:, k], style) for label, values, style in row.columns]
            # Only the last chart of a column has a time axis. It is higher, so that all plot areas are equally high.
            time, height = "", row.height
            if row is rows[-1]:
                time, height = "t [s]", row.height + MARGINS.bottom - MARGINS.bare
            axis = joint.axis(row.quantity, row.axis) if row.quantity else row.axis
            title = f"{row.title} of {joint.name}"
            charts.append(line_chart(lines, title, time, axis, motion=motion, height=height))
        panels.append(Panel(joint.name, tuple(charts)))
    return panels


def growth_panels(
    growths: Mapping[str, tuple[Growth, str]], styles: Mapping[str, str], banded: Container[str]
) -> list[Panel]:
    """Return the charts of relative error and tip error over the prediction horizon.

    Args:
        growths: {name of a line: (errors of all predictors of an evaluation, name of the predictor to show)}.
        styles: {name of a line: CSS class}.
        banded: Names of the lines with a band from the 10 % to the 90 % quantile.
    """
    panels = []
    for title, label, errors_of in MEASURES:
        marks: list[Mark] = []
        errors = {}
        for name, (growth, predictor) in growths.items():
            error = errors_of(growth).get(predictor)
            if error is None:
                continue
            errors[name] = error
            marks.append(Line(name, growth.seconds, error.median, styles[name]))
            if name in banded:
                marks.append(Band(f"{name}, 10 to 90 %", growth.seconds, error.low, error.high, styles[name]))
        if marks:
            chart = line_chart(
                marks, f"{title}: error by horizon", "horizon [s]", label, log=True, log_x=True,
                limits=_error_limits(errors), width=520, height=260,
            )  # fmt: skip
            panels.append(Panel(title, (chart,)))
    return panels


def _error_limits(errors: Mapping[str, Quantiles]) -> tuple[float, float] | None:
    """Return the limits of the axis of prediction errors, so that errors of diverged baselines do not extend it.

    The limits include the quantiles of the model, and the medians of all predictors except values above
    `TUNING.outlier` times the largest quantile of the model. None is returned if `errors`, {name of a line: quantiles},
    has no entry of the model, or no positive error.
    """
    # A page of several runs has one line per run and no baselines, so its axis is not limited.
    if labels.MODEL not in errors:
        return None
    model_errors = np.concatenate([errors[labels.MODEL].low, errors[labels.MODEL].high])
    values = np.concatenate([model_errors, *(error.median for error in errors.values())])
    # Zeros are excluded from the logarithmic axis. Diverged baselines are excluded, as they would compress all lines.
    values = values[(values > 0) & (values <= TUNING.outlier * np.nanmax(model_errors))]
    if not values.size:
        return None
    return float(values.min()) / 1.3, 1.3 * float(values.max())


def trajectory_panels(
    predictions: Mapping[str, PredictedMotion],
    styles: Mapping[str, str],
    joints: Sequence[labels.NamedJoint],
    motion: str = "",
) -> list[Panel]:
    """Return the charts of each joint: position and position error and, if logged, velocity and velocity error.

    Args:
        predictions: {name of a line: prediction}; all predictions are of the same motion.
        styles: {name of a line: CSS class}.
        joints: Names and units of the joints.
        motion: Name of the animated motion with the same time axis.
    """
    measured = next(iter(predictions.values()))
    # A replayed log of position servos has no velocities, so its charts of velocity are omitted.
    positions = {name: x.predicted_q for name, x in predictions.items()}
    velocities = {name: x.predicted_qd for name, x in predictions.items() if x.predicted_qd is not None}
    rows = []
    quantities = ("position", measured.q, positions), ("velocity", measured.qd, velocities)
    for quantity, values, predicted in quantities:
        if values is None:
            continue
        lines, errors = [("measured", values, "truth")], []
        # The command is the first curve, so that the measured curve is drawn above it.
        if measured.u is not None:
            lines.insert(0, ("commanded", measured.u, "hold"))
        for name, curve in predicted.items():
            lines.append((name, curve, styles[name]))
            errors.append((name, curve - values, styles[name]))
        rows.append(JointRow(quantity, quantity, quantity, lines))
        # Errors have their own chart: on the scale of the motion they would be a flat line.
        rows.append(JointRow(f"Error of the {quantity}", "error", quantity, errors, 100))
    return stacks(measured.t, rows, joints, motion)


def mass_panels(
    t: Values,
    masses: Mapping[str, np.ndarray],
    styles: Mapping[str, str],
    joint_types: Sequence[str],
    width: int = 330,
) -> list[Panel]:
    """Return one chart over time for each entry of M that is not always zero.

    Args:
        t: Times, (T,) [s].
        masses: {name of a line: lower triangle of M in row-major order, (entries, T) [kg m^2, kg m, kg]}.
        styles: {name of a line: CSS class}.
        joint_types: Types of the joints, for the units of the entries.
        width: Width of each chart [pixels].
    """
    panels = []
    # An entry of M whose magnitude never exceeds `zero` is zero except for rounding errors, and gets no chart.
    zero = TUNING.zero * max(np.nanmax(np.abs(mass)) for mass in masses.values())
    for number, (i, j) in enumerate(np.argwhere(np.tri(len(joint_types))).tolist()):
        lines = [Line(label, t, mass[number], styles[label]) for label, mass in masses.items()]
        if np.nanmax(np.abs([line.heights for line in lines])) > zero:
            name = labels.entry_name(i, j)
            # An entry between a revolute and a prismatic joint has the unit of a first moment.
            unit = labels.UNITS[joint_types[i]].inertia if joint_types[i] == joint_types[j] else "kg m"
            chart = line_chart(lines, name, "t [s]", f"{name} [{unit}]", width=width)
            panels.append(Panel(name, (chart,)))
    return panels
