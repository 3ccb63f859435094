"""Groups of charts that several pages show: quantities per joint, prediction errors, entries of M."""

from collections import defaultdict
from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from spelgen import labels
from spelgen.evaluation.drawn_motions import PredictedMotion
from spelgen.evaluation.traces import MassTrace, Quantiles
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


def growth_chart(
    errors: Mapping[str, tuple[Values, Quantiles]], styles: Mapping[str, str], banded: Container[str]
) -> Chart:
    """Return the chart of the relative error over the prediction horizon.

    Args:
        errors: {name of a line: (times since the start of a prediction [s], relative error)}.
        styles: {name of a line: CSS class}.
        banded: Names of the lines with a band from the 10 % to the 90 % quantile.
    """
    marks: list[Mark] = []
    for name, (seconds, error) in errors.items():
        marks.append(Line(name, seconds, error.median, styles[name]))
        if name in banded:
            marks.append(Band(f"{name}, 10 to 90 %", seconds, error.low, error.high, styles[name]))
    return line_chart(
        marks, "Relative error: error by horizon", "horizon [s]", "error / motion", log=True, log_x=True,
        limits=_error_limits(errors), width=520, height=260,
    )  # fmt: skip


def _error_limits(errors: Mapping[str, tuple[Values, Quantiles]]) -> tuple[float, float] | None:
    """Return the limits of the axis of prediction errors, so that errors of diverged baselines do not extend it.

    The limits include the 10 % and 90 % quantiles of the error of the model, and the median errors of all predictors.
    Medians above `TUNING.outlier` times the largest quantile of the model are excluded. None is returned if `errors`,
    see `growth_chart`, has no entry of the model, or no positive error.
    """
    # A page of several runs has one line per run and no baselines that could extend the axis, so the axis is not
    # limited.
    if labels.MODEL not in errors:
        return None
    _, of_model = errors[labels.MODEL]
    model_errors = np.concatenate([of_model.low, of_model.high])
    values = np.concatenate([model_errors, *(error.median for _, error in errors.values())])
    # Zeros are excluded from the logarithmic axis. Diverged baselines are excluded, as they would compress all lines.
    values = values[(values > 0) & (values <= TUNING.outlier * np.nanmax(model_errors))]
    if not values.size:
        return None
    return float(values.min()) / 1.3, 1.3 * float(values.max())


def trajectory_panels(
    example: PredictedMotion, joints: Sequence[labels.NamedJoint], motion: str
) -> list[Panel]:
    """Return the charts of each joint: position and position error and, if logged, velocity and velocity error.

    Args:
        example: A measured motion and its prediction.
        joints: Names and units of the joints.
        motion: Name of the animated motion with the same time axis.
    """
    rows = []
    position = ("position", example.q, example.predicted_q)
    velocity = ("velocity", example.qd, example.predicted_qd)
    for quantity, measured, predicted in (position, velocity):
        # A replayed log of position servos has no velocities, so its charts of velocity are omitted.
        if measured is None or predicted is None:
            continue
        lines = [("measured", measured, "truth"), ("predicted", predicted, "predicted")]
        # The command is the first curve, so that the measured curve is drawn above it.
        if example.u is not None:
            lines.insert(0, ("commanded", example.u, "hold"))
        rows.append(JointRow(quantity, quantity, quantity, lines))
        # The error has its own chart: on the scale of the motion it would be a flat line.
        error = [("predicted", predicted - measured, "predicted")]
        rows.append(JointRow(f"Error of the {quantity}", "error", quantity, error, 100))
    return stacks(example.t, rows, joints, motion)


def mass_panels(trace: MassTrace, joint_types: Sequence[str]) -> list[Panel]:
    """Return one chart over time for each entry of M that is not always zero.

    Args:
        trace: Entries of M along a trajectory, of one predictor at least.
        joint_types: Types of the joints, for the units of the entries.
    """
    panels = []
    # An entry of M whose magnitude never exceeds `zero` is zero except for rounding errors, and gets no chart.
    zero = TUNING.zero * max(np.nanmax(np.abs(curves.entries)) for curves in trace.by.values())
    for number, (i, j) in enumerate(np.argwhere(np.tri(len(joint_types))).tolist()):
        lines = [
            Line(name, trace.t, curves.entries[number], STYLES[name]) for name, curves in trace.by.items()
        ]
        if np.nanmax(np.abs([line.heights for line in lines])) > zero:
            name = labels.entry_name(i, j)
            # An entry between a revolute and a prismatic joint has the unit of a first moment.
            unit = labels.UNITS[joint_types[i]].inertia if joint_types[i] == joint_types[j] else "kg m"
            chart = line_chart(lines, name, "t [s]", f"{name} [{unit}]", width=330)
            panels.append(Panel(name, (chart,)))
    return panels
