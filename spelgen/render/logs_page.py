"""The page of a report on logs, with charts of the logged quantities of each joint."""

from __future__ import annotations

import numpy as np

from spelgen.arm.arm import Chain
from spelgen.dynamics.regressor_dynamics import regressor, urdf_parameters
from spelgen.labels import named_joints
from spelgen.log_checks.report import LogReport
from spelgen.logs.trajectory import Trajectory, joined_column, split_at_gaps
from spelgen.render.charts import TUNING
from spelgen.render.page import render_page
from spelgen.render.plots import JointRow, Panel, stacks


def page(report: LogReport, arm: Chain, inputs: np.ndarray) -> str:
    """Return the page about the report. inputs: G, (n, n), joint torques = G times logged torques."""
    return render_page(
        "logs.html.jinja",
        robot=report.robot,
        heading=report.heading(),
        tables=report.listings(),
        findings=report.findings,
        errors=report.errors,
        examples=[(log.name, charts(log, arm, inputs)) for log in report.examples],
    )


def charts(log: Trajectory, arm: Chain, inputs: np.ndarray) -> list[Panel]:
    """Return charts of each joint: position; velocity with dq/dt; torque with the URDF's gravity torque.

    Of position servos: position with command. inputs: G, (n, n), see `page`.
    """
    # split first, so that dq/dt has no difference across a gap
    segments = [segment[:: -(-len(log.t) // TUNING.points)] for segment in split_at_gaps(log)]
    t, q = joined_column(segments, "t"), joined_column(segments, "q")
    position = [("logged", q, "truth")]
    rows = [JointRow("position", "position", "position", position)]
    if log.u is not None:
        position.append(("commanded", joined_column(segments, "u"), "predicted"))
    else:
        derivative = np.concatenate(list(map(_derivative, segments)))
        velocity = [("logged", joined_column(segments, "qd"), "truth"), ("dq/dt", derivative, "predicted")]
        torque = [("logged", joined_column(segments, "tau") @ inputs.T, "truth")]
        if any(body.inertia for body in arm.bodies):
            still = np.zeros_like(q)
            gravity = regressor(arm, q, still, still) @ urdf_parameters(arm)  # (T, n)
            torque.append(("gravity of the URDF", gravity, "predicted"))
        rows.append(JointRow("velocity", "velocity", "velocity", velocity))
        rows.append(JointRow("torque", "torque", "torque", torque))
    return stacks(t, rows, named_joints(arm.joint_names, arm.joint_types))


def _derivative(segment: Trajectory) -> np.ndarray:
    """Return dq/dt, (T, n) [rad/s, m/s], by differences of the subsampled positions; NaN for a single sample."""
    if len(segment.t) < 2:
        return np.full_like(segment.q, np.nan)
    derivative: np.ndarray = np.gradient(segment.q, segment.t, axis=0)
    return derivative
