"""A report on logs as one self-contained HTML page, with what was logged drawn joint by joint."""

from __future__ import annotations

import numpy as np

from spelgen.arm.arm import Arm
from spelgen.dynamics.regressor import regressor, urdf_parameters
from spelgen.labels import named_joints
from spelgen.log_checks.report import LogReport
from spelgen.logs.trajectory import Trajectory, joined_column, split_at_gaps
from spelgen.render.page import render_page
from spelgen.render.plots import JointRow, Panel, stacks
from spelgen.render.tuning import TUNING


def page(report: LogReport, arm: Arm, inputs: np.ndarray) -> str:
    """Return the page about the report. It needs no other file, and names are escaped.

    inputs: G (n, n), which takes logged torques to the joints'.
    """
    return render_page(
        "logs.html.jinja",
        robot=report.robot,
        heading=report.heading(),
        tables=report.listings(),
        findings=report.findings,
        errors=report.errors,
        examples=[(log.name, charts(log, arm, inputs)) for log in report.examples],
    )


def charts(log: Trajectory, arm: Arm, inputs: np.ndarray) -> list[Panel]:
    """Return by joint q; qd beside dq/dt; torque beside the URDF's gravity torque. Of servos: q beside u."""
    # gaps are kept: no line is drawn over one by a slope across it
    pieces = [piece[:: -(-len(log.t) // TUNING.points)] for piece in split_at_gaps(log)]
    t, q = joined_column(pieces, "t"), joined_column(pieces, "q")
    position = [("logged", q, "truth")]
    rows = [JointRow("position", "position", "position", position)]
    if log.u is not None:
        position.append(("commanded", joined_column(pieces, "u"), "predicted"))
    else:
        slope = np.concatenate(list(map(_slope, pieces)))
        velocity = [("logged", joined_column(pieces, "qd"), "truth"), ("dq/dt", slope, "predicted")]
        torque = [("logged", joined_column(pieces, "tau") @ inputs.T, "truth")]
        if any(body.inertia for body in arm.bodies):
            still = np.zeros_like(q)
            gravity = regressor(arm, q, still, still) @ urdf_parameters(arm)  # (T, n)
            torque.append(("gravity of the URDF", gravity, "predicted"))
        rows.append(JointRow("velocity", "velocity", "velocity", velocity))
        rows.append(JointRow("torque", "torque", "torque", torque))
    return stacks(t, rows, named_joints(arm.joint_names, arm.joint_types))


def _slope(piece: Trajectory) -> np.ndarray:
    """Return dq/dt (T, n) by differences of what is drawn; NaN for a sample alone."""
    if len(piece.t) < 2:
        return np.full_like(piece.q, np.nan)
    slope: np.ndarray = np.gradient(piece.q, piece.t, axis=0)
    return slope
