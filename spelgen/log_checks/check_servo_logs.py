"""Logs of commanded positions beside a robot: what they hold, how joints follow, and what is odd about it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np

from spelgen.arm.arm import Coordinate
from spelgen.errors import Diagnostic, LogError
from spelgen.log_checks.following import DELAYS, NOW, Following
from spelgen.log_checks.report import range_fraction
from spelgen.log_checks.servo_report import ServoJointReport, ServoLogReport
from spelgen.log_checks.statistics import (
    DENSE,
    Clock,
    clock_of,
    common_step,
    noise_level,
    quantisation_step,
)
from spelgen.logs.checks import DEGREES, Finding, findings, gap_diagnostics, summarised
from spelgen.logs.trajectory import Trajectory, require_commands, require_joints

if TYPE_CHECKING:
    from spelgen.loaded_arm import LoadedArm

EXAMPLES = 2  # trajectories that are drawn
ALIKE, UNLIKE = 0.9, 0.5  # correlations of a command with the position that is, or is not, that of its joint
SPARSE = 20.0  # Hz, below which delays and friction are not seen
BEYOND = 1e-3  # rad, m that rounding overruns a limit by
USUAL = 0.9  # quantile


def check_servo_logs(logs: Iterable[Trajectory], arm: LoadedArm) -> ServoLogReport:
    """All about logs of commanded positions, read once; nothing is repaired or raised but what `check_logs` raises."""
    coordinates = arm.arm.coordinates
    joints, kinds = [c.name for c in coordinates], [c.kind for c in coordinates]
    seen = [_Signals(k) for k in range(len(joints))]
    following, clocks = Following(_reaches(arm)), []
    examples: list[Trajectory] = []
    notes: list[Diagnostic] = []
    odd: list[Finding] = []
    for trajectory in logs:
        require_joints(trajectory, joints)
        require_commands(trajectory)
        clocks.append(clock_of(trajectory))
        following.add(trajectory)
        for each in seen:
            each.add(trajectory)
        odd += findings(trajectory, joints, kinds)
        notes += gap_diagnostics(trajectory)
        if len(examples) < EXAMPLES:
            examples.append(trajectory)
    if not clocks:
        raise LogError("no trajectory", expected="at least one")
    about, errors = summarised(odd, joints, len(clocks))
    notes += about
    for k, coordinate in enumerate(coordinates):
        wrong = _wrong_command(k, joints, following)
        errors += [wrong] if wrong else []
        notes += [] if wrong else _odd_command(k, coordinate, seen[k], following)
    notes += _sparse(clocks)
    return ServoLogReport(
        robot=arm.arm.name,
        files=len({each.file for each in clocks} - {None}),
        trajectories=tuple(clocks),
        joints=(),
        findings=tuple(notes),
        errors=tuple(errors),
        examples=tuple(examples),
        servos=tuple(_joint(arm, k, seen[k], following) for k in range(len(joints))),
        delay=following.delay(),
    )


class _Signals:
    """Ends, noise and steps of one joint's signals over recordings."""

    def __init__(self, joint: int) -> None:
        self._joint = joint
        self.low, self.high = {"q": np.inf, "u": np.inf}, {"q": -np.inf, "u": -np.inf}
        self.noise: list[float] = []
        self.steps: dict[str, list[float]] = {"q": [], "u": []}
        self.same = True  # as if the positions had been logged twice

    def add(self, trajectory: Trajectory) -> None:
        q, u = (x[:, self._joint] for x in (trajectory.q, require_commands(trajectory)))
        for name, values in (("q", q), ("u", u)):
            self.low[name] = min(self.low[name], float(values.min()))
            self.high[name] = max(self.high[name], float(values.max()))
            self.steps[name].append(quantisation_step(values))
        self.same &= bool(np.array_equal(q, u))
        if trajectory.sample_rate >= DENSE and len(q) > 8:
            self.noise.append(float(noise_level(trajectory.t, q[:, None])[0]))


def _joint(arm: LoadedArm, k: int, seen: _Signals, following: Following) -> ServoJointReport:
    coordinate, moves = arm.arm.coordinates[k], bool(following.moves()[k])
    apart = following.apart(k)
    place = following.likeness(k, k).place if moves else NOW
    rest = np.abs(np.concatenate([np.zeros(0), *following.rest[k]]))
    kp = arm.settings.joint(coordinate.name).kp
    return ServoJointReport(
        name=coordinate.name,
        kind=coordinate.kind,
        q=(seen.low["q"], seen.high["q"]),
        u=(seen.low["u"], seen.high["u"]),
        range_fraction=range_fraction(coordinate, seen.low["q"], seen.high["q"]),
        noise=float(np.median(seen.noise)) if seen.noise else None,
        steps={name: common_step(x) for name, x in seen.steps.items()},
        behind=float(DELAYS[place]) if moves else None,
        apart=float(apart[place]),
        still=float(np.quantile(rest, USUAL)) if len(rest) else None,
        saturated=None if kp is None else float(following.far[k] / max(following.count, 1)),
    )


def _reaches(arm: LoadedArm) -> np.ndarray:
    """Distances from the command (n,) at which servos give all they can; infinite where that is not known."""
    known = [(x.effort, arm.settings.joint(x.name).kp) for x in arm.arm.coordinates]
    return np.array([effort / kp if effort and kp else np.inf for effort, kp in known])


def _wrong_command(k: int, joints: Sequence[str], following: Following) -> LogError | None:
    """Why a command cannot be that of its joint."""
    if not following.moves()[k]:
        return None
    where, (_, alike, factor) = f"joint {joints[k]!r}", following.likeness(k, k)
    if alike > ALIKE and (0.8 < factor * DEGREES < 1.25 or 0.8 < factor / DEGREES < 1.25):
        got = f"positions that move {factor:.3g} times as far as commands (180/pi is 57.3)"
        return LogError(
            got,
            element=where,
            expected="both in radians",
            do="say 'units' of q and u under 'logs' in the robot's YAML",
        )
    if alike < -ALIKE:
        got = f"positions that move against commands (correlation {alike:.2g})"
        return LogError(got, element=where, expected="one sense", do="check the signs of q and u")
    if alike < UNLIKE:
        for other, name in enumerate(joints):
            if other != k and following.likeness(k, other).correlation > ALIKE:
                got = f"a command that joint {name!r} follows, and this one does not"
                return LogError(
                    got, element=where, expected="its own command", do="check the names of the columns"
                )
    return None


def _odd_command(
    k: int, coordinate: Coordinate, seen: _Signals, following: Following
) -> Iterator[Diagnostic]:
    """What is odd about a joint's command."""
    where = f"joint {coordinate.name!r}"

    def odd(code: str, message: str) -> Diagnostic:
        return Diagnostic("warning", code, where, None, message)

    if seen.same:
        yield odd("commands-are-positions", "u is q, to the last bit: are the commands those that were sent?")
    elif not following.moves()[k]:
        span = seen.high["u"] - seen.low["u"]
        yield odd("idle-command", f"its command moves by {span:.3g} alone: what its servo is stays open")
    else:
        place, alike, _ = following.likeness(k, k)
        if alike < UNLIKE:
            yield odd("not-following", f"it does not follow its command (correlation {alike:.2g})")
        elif DELAYS[place] < 0:
            message = f"positions come {-1000 * DELAYS[place]:.0f} ms before commands: are rows shifted?"
            yield odd("ahead-of-command", message)
    lower, upper = (None, None) if coordinate.continuous else (coordinate.lower, coordinate.upper)
    for name in ("q", "u"):
        if lower is not None and seen.low[name] < lower - BEYOND:
            yield odd(
                "beyond-position-limit", f"{name} down to {seen.low[name]:.4g}, the limit is {lower:.4g}"
            )
        if upper is not None and seen.high[name] > upper + BEYOND:
            yield odd(
                "beyond-position-limit", f"{name} up to {seen.high[name]:.4g}, the limit is {upper:.4g}"
            )


def _sparse(clocks: Sequence[Clock]) -> Iterator[Diagnostic]:
    slow = [x for x in clocks if x.sample_rate < SPARSE]
    if slow:
        message = f"{slow[0].sample_rate:.3g} Hz: below {SPARSE:g} Hz delays and friction are hardly seen"
        yield Diagnostic("warning", "sparse", f"trajectory {slow[0].name}", None, message)
