"""Logs beside a robot: all that is measured, and what it gives to doubt."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from spelgen.arm.arm import Arm, Coordinate
from spelgen.errors import Diagnostic, SpelgenError, SpelgenErrors
from spelgen.logs.checks import doubts, tell, told_gaps
from spelgen.logs.gravity import GravityShare, StateSamples, gravity_shares, state_samples
from spelgen.logs.statistics import Clock, Measures, measure
from spelgen.logs.trajectory import QUANTITIES, Trajectory

EXAMPLES = 2  # trajectories that are drawn
BEYOND = 1e-3  # [rad, m, of a limit] a limit overrun by less is rounding
LOADED = 0.2  # spread of the URDF's gravity torque, of the torque's: from here on it must be seen
UNSEEN, SEEN = 0.3, 0.7  # correlation of torque and gravity: not in it below, certainly in it above
FACTORS = (0.2, 5.0)  # inertials in URDFs are often wrong, but not like this


@dataclass(frozen=True)
class JointSurvey:
    """One joint over all trajectories; [rad, m], [rad/s, m/s], [Nm, N]; None where it cannot be told.

    range_share: of the joint's range that was visited. noise: standard deviation of what changes from sample
    to sample. steps: of signals that are quantised. velocity_factor, velocity_correlation: both 1 where qd is
    dq/dt.
    """

    name: str
    kind: str
    low: dict[str, float]
    high: dict[str, float]
    range_share: float | None
    noise: dict[str, float] | None
    steps: dict[str, float | None]
    velocity_factor: float | None
    velocity_correlation: float | None
    gravity: GravityShare


@dataclass(frozen=True, eq=False)
class Survey:
    """What `spelgen logs` tells. errors: why the logs cannot be trained on. examples: to be drawn."""

    robot: str
    files: int
    trajectories: tuple[Clock, ...]
    joints: tuple[JointSurvey, ...]
    findings: tuple[Diagnostic, ...]
    errors: tuple[SpelgenError, ...]
    examples: tuple[Trajectory, ...]

    @property
    def samples(self) -> int:
        return sum(each.samples for each in self.trajectories)

    @property
    def duration(self) -> float:
        """Of all trajectories [s]."""
        return sum(each.duration for each in self.trajectories)

    def to_dict(self) -> dict[str, Any]:
        """JSON form, versioned by `schema`."""
        return {
            "schema": 1,
            "robot": self.robot,
            "files": self.files,
            "samples": self.samples,
            "duration": self.duration,
            "trajectories": [asdict(each) for each in self.trajectories],
            "joints": [asdict(each) for each in self.joints],
            "errors": [str(each) for each in self.errors],
            "findings": [each.to_dict() for each in self.findings],
        }


def survey(trajectories: Iterable[Trajectory], arm: Arm, inputs: np.ndarray) -> Survey:
    """All about the logs of an arm, read once, one trajectory after another. inputs: G (n, n), which takes
    logged torques to the joints'.
    """
    joints, kinds = [c.name for c in arm.coordinates], [c.kind for c in arm.coordinates]
    measured: list[Measures] = []
    samples: list[StateSamples] = []
    examples: list[Trajectory] = []
    found, findings = [], []
    for trajectory in trajectories:
        measured.append(measure(trajectory))
        samples.append(state_samples(trajectory, inputs))
        found += doubts(trajectory, joints, kinds)
        findings += told_gaps(trajectory)
        if len(examples) < EXAMPLES:
            examples.append(trajectory)
    errors: tuple[SpelgenError, ...] = ()
    try:
        findings += tell(found, joints, len(measured))
    except SpelgenErrors as several:
        errors = several.errors
    except SpelgenError as error:
        errors = (error,)
    told = [
        _joint(index, coordinate, measured, share)
        for index, (coordinate, share) in enumerate(
            zip(arm.coordinates, gravity_shares(arm, samples), strict=True)
        )
    ]
    for coordinate, joint in zip(arm.coordinates, told, strict=True):
        findings += [*_limits(coordinate, joint), *_gravity(joint)]
    return Survey(
        robot=arm.name,
        files=len({each.clock.file for each in measured}),
        trajectories=tuple(each.clock for each in measured),
        joints=tuple(told),
        findings=tuple(findings),
        errors=errors,
        examples=tuple(examples),
    )


def _joint(
    index: int, coordinate: Coordinate, measured: Sequence[Measures], share: GravityShare
) -> JointSurvey:
    low = {name: min(float(each.low[name][index]) for each in measured) for name in QUANTITIES}
    high = {name: max(float(each.high[name][index]) for each in measured) for name in QUANTITIES}
    dense = [each.noise for each in measured if each.noise is not None]
    agreement = measured[0].agreement
    for each in measured[1:]:
        agreement = agreement + each.agreement
    return JointSurvey(
        name=coordinate.name,
        kind=coordinate.kind,
        low=low,
        high=high,
        range_share=_range_share(coordinate, low["q"], high["q"]),
        noise={name: float(np.median([each[name][index] for each in dense])) for name in QUANTITIES}
        if dense
        else None,
        steps={name: _common_step([each.steps[name][index] for each in measured]) for name in QUANTITIES},
        velocity_factor=agreement.factor(index) if agreement.xx[index] > 0 else None,
        velocity_correlation=agreement.correlation(index),
        gravity=share,
    )


def _range_share(coordinate: Coordinate, low: float, high: float) -> float | None:
    if coordinate.continuous or coordinate.lower is None or coordinate.upper is None:
        return None
    width = coordinate.upper - coordinate.lower
    return (high - low) / width if width > 0 else None


def _common_step(steps: Sequence[float]) -> float | None:
    """The step of most trajectories, where the signal is quantised in most of them."""
    known = [step for step in steps if np.isfinite(step)]
    return float(np.median(known)) if 2 * len(known) > len(steps) else None


def _limits(coordinate: Coordinate, joint: JointSurvey) -> list[Diagnostic]:
    """Where the logs go beyond what the URDF allows."""
    unit = {"revolute": ("rad", "rad/s", "Nm"), "prismatic": ("m", "m/s", "N")}[joint.kind]
    speed, torque = (max(abs(joint.low[x]), abs(joint.high[x])) for x in ("qd", "tau"))
    over = []
    lower, upper = (None, None) if coordinate.continuous else (coordinate.lower, coordinate.upper)
    if lower is not None and joint.low["q"] < lower - BEYOND:
        over.append(("position", f"q down to {joint.low['q']:.4g} {unit[0]}, the limit is {lower:.4g}"))
    if upper is not None and joint.high["q"] > upper + BEYOND:
        over.append(("position", f"q up to {joint.high['q']:.4g} {unit[0]}, the limit is {upper:.4g}"))
    for name, value, limit, told in (
        ("velocity", speed, coordinate.velocity, unit[1]),
        ("effort", torque, coordinate.effort, unit[2]),
    ):
        if limit and value > limit * (1 + BEYOND):
            over.append((name, f"{name} up to {value:.4g} {told}, the limit is {limit:.4g}"))
    where = f"joint {joint.name!r}"
    return [Diagnostic("warning", f"beyond-{name}-limit", where, None, what) for name, what in over]


def _gravity(joint: JointSurvey) -> list[Diagnostic]:
    """Where the torque does not move with gravity as the URDF says."""
    share = joint.gravity
    if share.factor is None or share.correlation is None or (share.expected or 0.0) < LOADED:
        return []
    where, (low, high) = f"joint {joint.name!r}", FACTORS
    if abs(share.correlation) < UNSEEN:
        message = (
            f"tau does not move with gravity: their correlation is {share.correlation:.2g}, while the URDF's "
            f"gravity torque spreads {share.expected:.2g} times as wide as tau; is it compensated in the log?"
        )
        return [Diagnostic("warning", "torque-without-gravity", where, None, message)]
    if share.correlation < -SEEN:
        message = (
            f"tau moves against gravity: {share.factor:.3g} times the URDF's; a sign of tau or q is wrong"
        )
        return [Diagnostic("warning", "torque-against-gravity", where, None, message)]
    if share.correlation > SEEN and not low < share.factor < high:
        message = (
            f"tau moves with {share.factor:.3g} times the URDF's gravity torque; check its unit and gain"
        )
        return [Diagnostic("warning", "torque-scale", where, None, message)]
    return []
