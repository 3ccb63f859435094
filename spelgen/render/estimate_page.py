"""HTML page of `spelgen estimate`: payload, external torques and friction drift over time."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from spelgen.files import write_text
from spelgen.fitting.fitted import Fit
from spelgen.labels import named_joints
from spelgen.live.noise import NoiseLevels
from spelgen.live.replay import LogEstimate, payload_sentence
from spelgen.render.charts import Band, Chart, JointRow, Line, Mark, Panel, line_chart, stacks
from spelgen.templates import render_page


def write_estimate(fit: Fit, levels: NoiseLevels, results: Sequence[LogEstimate], path: Path) -> Path:
    """Write the page about the estimates of payload, external torque and friction drift along logs; return its path.

    Args:
        fit: fit of the model with which the estimates were made.
        levels: noise levels that the estimators use.
        results: estimates along each log.
        path: file of the page.
    """
    sections = [
        (result, payload_sentence(result.payload), mass_chart(result), joint_panels(fit, result))
        for result in results
    ]
    text = render_page("estimate.html.jinja", robot=fit.record.robot, sections=sections, levels=levels)
    return write_text(path, text)


def mass_chart(result: LogEstimate) -> Chart | None:
    """Return the chart of payload mass over time, with its 95 % interval; None if no payload was found.

    result: estimates along a log.
    """
    mass = np.array([state.payload.mass for state in result.states])
    # Without a payload there is no chart, since a line of zeros would suggest a measured mass.
    if not mass.any():
        return None
    low, high = np.array([state.payload.mass_interval for state in result.states]).T
    t = result.log.t - result.log.t[0]
    # The estimated mass is piecewise constant, so the band has points only before and after each change.
    corners = np.flatnonzero(np.diff(mass, prepend=np.nan) != 0)
    rows = np.unique(np.concatenate([corners, np.maximum(corners - 1, 0), [len(t) - 1]]))
    marks: list[Mark] = [
        Band("95 % interval", t[rows], low[rows], high[rows], "c2"),
        Line("mass", t, mass, "model"),
    ]
    return line_chart(marks, "Mass of the payload", "t [s]", "mass [kg]", width=820)


def joint_panels(fit: Fit, result: LogEstimate) -> list[Panel]:
    """Return two charts per joint: external torque with the thresholds of contact, and friction drift [%].

    The friction drift is the relative difference between the estimated friction and the friction of the model. fit: fit
    of the model with which the estimates were made. result: estimates along a log.
    """
    contacts = [state.contact for state in result.states]
    threshold = np.array([contact.threshold for contact in contacts])
    torque = [
        ("external torque", np.array([contact.external_torque for contact in contacts]), "model"),
        ("threshold of contact", threshold, "hold"),
        ("threshold, other direction", -threshold, "hold"),
    ]
    # Friction is shown as change in percent: a drift of a few percent is not visible on an axis that starts at zero.
    friction = [("friction drift", 100 * (np.array([x.friction_scale for x in result.states]) - 1), "c3")]
    rows = [
        JointRow("external torque", "external torque", "torque", torque),
        JointRow("friction relative to the model", "friction [%]", "", friction, 100),
    ]
    return stacks(
        result.log.t - result.log.t[0], rows, named_joints(tuple(result.drift), fit.model.joint_types)
    )
