"""A survey as tables of text: the same for the terminal and for the page."""

from __future__ import annotations

import textwrap

from spelgen.errors import Diagnostic
from spelgen.listing import WIDTH, Listing
from spelgen.logs.report import SEEN, JointSurvey, Survey
from spelgen.render.tables import number

MOST = 20  # trajectories that a terminal shows


def text(found: Survey) -> str:
    """The survey for a terminal."""
    parts = [heading(found), *(table.text() for table in listings(found, MOST))]
    if found.findings:
        parts.append("\n".join(["Findings", *map(_told, found.findings)]))
    else:
        parts.append("Nothing is odd.")
    return "\n\n".join(parts)


def heading(found: Survey) -> str:
    """One line: how much there is."""
    count = len(found.trajectories)
    return (
        f"{found.robot}: {count} trajector{'ies' if count != 1 else 'y'} in {found.files} "
        f"file{'s' * (found.files != 1)}, {found.duration:.4g} s, {found.samples} samples"
    )


def listings(found: Survey, most: int | None = None) -> list[Listing]:
    """All tables; of trajectories at most `most`."""
    return [_clocks(found, most), _ranges(found), _signals(found), _physics(found)]


def _clocks(found: Survey, most: int | None) -> Listing:
    head = ("trajectory", "samples", "duration", "rate", "jitter", "gaps", "longest")
    rows = [
        (
            each.name,
            str(each.samples),
            f"{each.duration:.4g} s",
            f"{each.rate:.4g} Hz",
            f"{each.jitter:.1%}",
            str(each.gaps),
            f"{each.longest_gap:.3g} s" if each.gaps else "-",
        )
        for each in found.trajectories
    ]
    left = 0 if most is None else max(0, len(rows) - most)
    return Listing("Clock", head, tuple(rows[: len(rows) - left]), f"and {left} more" if left else "")


def _ranges(found: Survey) -> Listing:
    head = ("joint", "q", "of its range", "qd", "tau")
    rows = []
    for joint in found.joints:
        spans = [f"{number(joint.low[name])} .. {number(joint.high[name])}" for name in ("q", "qd", "tau")]
        share = "-" if joint.range_share is None else f"{joint.range_share:.0%}"
        rows.append((joint.name, spans[0], share, *spans[1:]))
    return Listing("Ranges [rad, rad/s, Nm; m, m/s, N]", head, tuple(rows))


def _signals(found: Survey) -> Listing:
    names = ("q", "qd", "tau")
    head = ("joint", *(f"{name} noise" for name in names), *(f"{name} step" for name in names))
    rows = [
        (joint.name, *(number((joint.noise or {}).get(name)) for name in names), *map(number, _steps(joint)))
        for joint in found.joints
    ]
    note = (
        "noise: standard deviation of what changes from sample to sample, from 50 Hz on; "
        "step: between the levels of a quantised signal; in the units above."
    )
    return Listing("Signals", head, tuple(rows), note)


def _steps(joint: JointSurvey) -> list[float | None]:
    return [joint.steps[name] for name in ("q", "qd", "tau")]


def _physics(found: Survey) -> Listing:
    head = ("joint", "dq/dt : qd", "agree", "gravity in tau", "x URDF")
    rows = [
        (
            joint.name,
            number(joint.velocity_factor),
            number(joint.velocity_correlation),
            _share(joint),
            number(joint.gravity.factor if abs(joint.gravity.correlation or 0) > SEEN else None),
        )
        for joint in found.joints
    ]
    note = (
        "dq/dt : qd and its correlation are 1 where qd is the derivative of q; gravity in tau: part of tau's "
        "variance, beside friction and acceleration, that gravity explains; x URDF: how many times the URDF's "
        "own gravity torque that is."
    )
    return Listing("Physics", head, tuple(rows), note)


def _share(joint: JointSurvey) -> str:
    return "never loaded" if joint.gravity.explained is None else f"{joint.gravity.explained:.0%}"


def _told(finding: Diagnostic) -> str:
    told = f"{finding.severity}: {finding.where}: {finding.message}"
    return textwrap.fill(told, WIDTH, initial_indent="  ", subsequent_indent="    ")
