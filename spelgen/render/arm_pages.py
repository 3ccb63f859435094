"""HTML pages about an arm: derived structure, proposed motion, and logs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from spelgen.arm.arm import Chain
from spelgen.arm.configured_arm import Arm
from spelgen.certificate import formula_files
from spelgen.certificate.formulas import Formulas
from spelgen.certificate.inspection import Inspection, range_text
from spelgen.dynamics.regressor_dynamics import regressor, urdf_parameters
from spelgen.excitation.excitation import ADVICE, Excitation
from spelgen.labels import named_joints
from spelgen.log_checks.report import LogReport
from spelgen.logs.trajectory import Trajectory, joined_column, split_at_gaps
from spelgen.render.arm_section import AnimatedMotion, arm_section, matrix
from spelgen.render.charts import TUNING, JointRow, Panel, stacks
from spelgen.templates import render_page

if TYPE_CHECKING:
    from spelgen.certificate.verify import Verification


def inspection_page(
    inspection: Inspection,
    closed: Formulas | None = None,
    proof: Verification | None = None,
    urdf: Path | None = None,
) -> str:
    """Return the page about the derived structure of an arm.

    Args:
        inspection: The derived structure.
        closed: Closed-form formulas of the mass matrix M(q) and the potential energy V(q); None: the page has none.
        proof: Verification of the structure; None: the structure was not verified.
        urdf: URDF of the arm, from which the picture of the arm is drawn; None: the page has no picture.
    """
    return render_page(
        "inspection.html.jinja",
        found=inspection,
        cells=matrix(inspection.arm, inspection.structure),
        arm=None if urdf is None else arm_section(inspection.arm, urdf),
        joints=[(joint.name, joint.joint_type, range_text(joint)) for joint in inspection.arm.coordinates],
        closed=None if closed is None else formula_files.text(closed, width=100),
        proof=proof,
    )


def motion_page(excitation: Excitation, arm: Arm) -> str:
    """Return the page about a proposed motion of `arm`, including the approach to its first position.

    excitation: the proposed motion and the approach.
    """
    motion = excitation.approach.then(excitation.motion)
    # Charts subsample their lines, but the animation shows every point. Therefore the motion is subsampled here.
    # `step` is rounded up, so that at most 2 * TUNING.points points remain.
    step = -(-len(motion.t) // (2 * TUNING.points))
    t, q, qd = (x[::step] for x in (motion.t, motion.q, motion.qd))
    drawn = AnimatedMotion("motion", "approach and motion", t.round(3), q.round(4))
    rows = [
        JointRow("position", "position", "position", [("approach and motion", q, "model")]),
        JointRow("velocity", "velocity", "velocity", [("approach and motion", qd, "model")]),
    ]
    return render_page(
        "motion.html.jinja",
        excitation=excitation,
        table=excitation.listing(),
        advice=ADVICE,
        arm=arm_section(arm.chain, arm.robot.path, [drawn]),
        panels=stacks(t, rows, named_joints(arm.chain.joint_names, arm.chain.joint_types), "motion"),
    )


def logs_page(report: LogReport, arm: Chain, inputs: np.ndarray) -> str:
    """Return the page about a report on logs, with charts of up to two logs.

    inputs: input matrix G (n, n): joint torques = G times logged torques.
    """
    return render_page(
        "logs.html.jinja",
        robot=report.robot,
        heading=report.heading(),
        tables=report.listings(),
        findings=report.findings,
        errors=report.errors,
        examples=[(log.name, log_charts(log, arm, inputs)) for log in report.examples],
    )


def log_charts(log: Trajectory, arm: Chain, inputs: np.ndarray) -> list[Panel]:
    """Return the charts of each joint along a log: position, velocity and torque.

    The chart of the velocity also shows dq/dt, and the chart of the torque also shows the gravity torque of the URDF. A
    log of position servos has only the chart of the position, which also shows the command. inputs: input matrix G (n,
    n): joint torques = G times logged torques.
    """
    # The log is split at gaps first, so that dq/dt contains no difference across a gap.
    segments = [segment[:: -(-len(log.t) // TUNING.points)] for segment in split_at_gaps(log)]
    t, q = joined_column(segments, "t"), joined_column(segments, "q")
    position = [("logged", q, "truth")]
    rows = [JointRow("position", "position", "position", position)]
    # Logs of position servos contain commands in place of velocities and torques, so the charts of velocity and torque
    # are omitted.
    if log.u is not None:
        position.append(("commanded", joined_column(segments, "u"), "predicted"))
    else:
        derivative = np.concatenate(list(map(_derivative, segments)))
        velocity = [("logged", joined_column(segments, "qd"), "truth"), ("dq/dt", derivative, "predicted")]
        torque = [("logged", joined_column(segments, "tau") @ inputs.T, "truth")]
        if any(body.inertia for body in arm.bodies):
            # Only the gravity torque is shown: with the other terms a wrong sign or unit of the torque is hard to see.
            still = np.zeros_like(q)
            gravity = regressor(arm, q, still, still) @ urdf_parameters(arm)  # gravity torque (T, n) [Nm, N]
            torque.append(("gravity of the URDF", gravity, "predicted"))
        rows.append(JointRow("velocity", "velocity", "velocity", velocity))
        rows.append(JointRow("torque", "torque", "torque", torque))
    return stacks(t, rows, named_joints(arm.joint_names, arm.joint_types))


def _derivative(segment: Trajectory) -> np.ndarray:
    """Return dq/dt, (T, n) [rad/s, m/s], by central differences of the positions; NaN for a segment of one sample."""
    if len(segment.t) < 2:
        return np.full_like(segment.q, np.nan)
    return np.asarray(np.gradient(segment.q, segment.t, axis=0))
