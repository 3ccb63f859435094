"""The page of a proposed motion: the moving arm, its quality, and charts of each joint."""

from __future__ import annotations

from spelgen.arm.configured_arm import Arm
from spelgen.excitation.excitation import ADVICE, Excitation
from spelgen.labels import named_joints
from spelgen.render.arm_section import AnimatedMotion, arm_section
from spelgen.render.charts import TUNING
from spelgen.render.page import render_page
from spelgen.render.plots import JointRow, stacks

NAME = "motion"


def page(excitation: Excitation, arm: Arm) -> str:
    """Return the page about a motion of `arm`, approach included."""
    motion = excitation.approach.then(excitation.motion)
    step = -(-len(motion.t) // (2 * TUNING.points))  # ceil
    t, q, qd = (x[::step] for x in (motion.t, motion.q, motion.qd))
    drawn = AnimatedMotion(NAME, "approach and motion", t.round(3), q.round(4))
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
        panels=stacks(t, rows, named_joints(arm.chain.joint_names, arm.chain.joint_types), NAME),
    )
