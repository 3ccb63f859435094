"""A report on logs as one self-contained HTML page, with what was logged drawn joint by joint."""

from __future__ import annotations

import numpy as np
from markupsafe import Markup

from spelgen.arm.arm import Arm
from spelgen.dynamics.regressor import regressor, urdf_parameters
from spelgen.log_checks.report import LogReport
from spelgen.logs.trajectory import Trajectory, split_at_gaps
from spelgen.render.charts import Line, line_chart
from spelgen.render.page import render_page
from spelgen.render.plots import FORCE, UNITS, Panel

DRAWN = 300  # points of a line: what `line_chart` shows


def page(found: LogReport, arm: Arm, inputs: np.ndarray) -> str:
    """The page about ``found``. It needs no other file, and names are escaped.

    inputs: G (n, n), which takes logged torques to the joints'.
    """
    return render_page(
        "logs.html.jinja",
        robot=found.robot,
        heading=found.heading(),
        tables=found.listings(),
        findings=found.findings,
        errors=found.errors,
        examples=[(each.name, charts(each, arm, inputs)) for each in found.examples],
    )


def charts(trajectory: Trajectory, arm: Arm, inputs: np.ndarray) -> list[Panel]:
    """By joint: q; qd beside dq/dt; the joint's torque beside the URDF's gravity torque. Of servos: q beside u."""
    if trajectory.u is not None:
        return _following(trajectory, arm)
    stride = -(-len(trajectory.t) // DRAWN)
    pieces = [piece[::stride] for piece in split_at_gaps(trajectory)]
    t, q, qd, tau = (
        np.concatenate([getattr(piece, name) for piece in pieces]) for name in ("t", "q", "qd", "tau")
    )
    slope, tau = np.concatenate([_slope(piece) for piece in pieces]), tau @ inputs.T
    still = np.zeros_like(q)
    gravity = regressor(arm, q, still, still) @ urdf_parameters(arm)  # (T, n)
    known = any(body.inertia for body in arm.bodies)
    drawn = []
    for k, coordinate in enumerate(arm.coordinates):
        units, force = UNITS[coordinate.kind], FORCE[coordinate.kind]
        torque = [Line("logged", t, tau[:, k], "truth")]
        torque += [Line("gravity of the URDF", t, gravity[:, k], "predicted")] if known else []
        lines = (
            ("position", units[0], [Line("logged", t, q[:, k], "truth")]),
            (
                "velocity",
                units[1],
                [Line("logged", t, qd[:, k], "truth"), Line("dq/dt", t, slope[:, k], "predicted")],
            ),
            ("torque", force, torque),
        )
        name = coordinate.name
        charts = [_chart(what, unit, name, each, last=what == "torque") for what, unit, each in lines]
        drawn.append(Panel(name, tuple(charts)))
    return drawn


def _following(trajectory: Trajectory, arm: Arm) -> list[Panel]:
    pieces = [piece[:: -(-len(trajectory) // DRAWN)] for piece in split_at_gaps(trajectory)]
    t, q, u = (np.concatenate([getattr(piece, name) for piece in pieces]) for name in ("t", "q", "u"))
    drawn = []
    for k, coordinate in enumerate(arm.coordinates):
        lines = [Line("logged", t, q[:, k], "truth"), Line("commanded", t, u[:, k], "predicted")]
        chart = _chart("position", UNITS[coordinate.kind][0], coordinate.name, lines, last=True)
        drawn.append(Panel(coordinate.name, (chart,)))
    return drawn


def _chart(what: str, unit: str, joint: str, lines: list[Line], *, last: bool) -> Markup:
    t, height = ("t [s]", 158) if last else ("", 130)
    return line_chart(lines, f"{what} of {joint}", t, f"{what} [{unit}]", height=height)


def _slope(piece: Trajectory) -> np.ndarray:
    """dq/dt (T, n) by differences of what is drawn; NaN for a sample alone."""
    if len(piece.t) < 2:
        return np.full_like(piece.q, np.nan)
    return np.gradient(piece.q, piece.t, axis=0)
