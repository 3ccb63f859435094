"""Columns of charts, one column per joint, that several pages show."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from spelgen.labels import NamedJoint
from spelgen.render.charts import MARGINS, Chart, Line, Values, line_chart


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
    t: Values, rows: Sequence[JointRow], joints: Sequence[NamedJoint], motion: str = ""
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
