"""What is odd about logs: gaps, columns that never change, velocities that are no derivative, degrees.

Nothing is repaired. Each trajectory is checked by itself, so that logs need not lie in memory together.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from spelgen.errors import Diagnostic, LogError, SpelgenError, collect
from spelgen.logs.trajectory import Trajectory, gap_ends, split_at_gaps

SPAN = 10  # steps over which q and the integral of qd are compared: quantisation of q then hides little
DRIFT = 0.05  # [rad, m] that qd must say a joint moved, before a q that never changes is called frozen
AGREEMENT, DEVIATION = 0.9, 0.1  # least correlation of q with the integral of qd, largest |factor - 1|
DEGREES = 180.0 / np.pi
TURNS = 4 * np.pi  # [rad] no revolute joint turns further, so what does is in degrees

Code = Literal["degrees", "frozen", "velocity-is-no-derivative", "constant-torque", "joint-at-rest"]
CODES: tuple[Code, ...] = (
    "degrees", "frozen", "velocity-is-no-derivative", "constant-torque", "joint-at-rest",
)  # fmt: skip
ERRORS = {  # findings that are errors: what is expected, what to do
    "degrees": (
        "radians and rad/s",
        "convert degrees, by 'units' under 'logs' in the robot's YAML; if the units are right, say so there, "
        "or in the Parquet schema's metadata 'units'",
    ),
    "frozen": ("columns that belong together", "check the logger, and the names of the columns"),
}


@dataclass(frozen=True)
class Finding:
    """One thing that is odd about one joint of one trajectory. everywhere: odd only where all trajectories show it."""

    code: Code
    trajectory: str
    file: Path | None
    joint: str
    what: str
    everywhere: bool = False


@dataclass(frozen=True, eq=False)
class VelocityAgreement:
    """Sums over increments y of q and of the integral x of qd, over SPAN steps, for n joints.

    xx, yy: (n,). xy: (n, n), of qd of the joint of the row with q of that of the column.
    """

    xx: np.ndarray
    yy: np.ndarray
    xy: np.ndarray

    def __add__(self, other: VelocityAgreement) -> VelocityAgreement:
        return VelocityAgreement(self.xx + other.xx, self.yy + other.yy, self.xy + other.xy)

    def factor(self, joint: int) -> float:
        """By what qd must be multiplied to be dq/dt; 1 where qd says nothing."""
        return float(self.xy[joint, joint] / self.xx[joint]) if self.xx[joint] > 0 else 1.0

    def correlation(self, joint: int, other: int | None = None) -> float | None:
        """1: qd of a joint is dq/dt, of the other one or its own, but for a factor; None where one is at rest."""
        other = joint if other is None else other
        size = float(np.sqrt(self.xx[joint]) * np.sqrt(self.yy[other]))
        return None if size < 1e-12 else float(self.xy[joint, other]) / size


def check(
    trajectories: Iterable[Trajectory], joints: Sequence[str], joint_types: Sequence[str]
) -> list[Diagnostic]:
    """What is odd about the logs, nothing repaired.

    Raises LogError when revolute joints look recorded in degrees, unless units are declared, and when a
    position or a velocity never changes while the other one does.
    """
    gaps, found, count = [], [], 0
    for trajectory in trajectories:
        gaps += gap_diagnostics(trajectory)
        found += findings(trajectory, joints, joint_types)
        count += 1
    notes, errors = summarised(found, joints, count)
    collect(errors)
    return [*gaps, *notes]


def gap_diagnostics(trajectory: Trajectory) -> list[Diagnostic]:
    """A note where the recording has holes."""
    pieces = len(gap_ends(trajectory.t)) - 1
    if pieces == 1:
        return []
    longest = np.diff(trajectory.t).max()
    message = f"{pieces - 1} gaps in time, up to {longest:.3g} s long; no window crosses one"
    return [Diagnostic("info", "gap", f"trajectory {trajectory.name}", None, message)]


def summarised(
    found: Sequence[Finding], joints: Sequence[str], trajectories: int
) -> tuple[list[Diagnostic], list[SpelgenError]]:
    """Findings about that many trajectories, a sentence for each joint and kind: notes, and what `check` raises."""
    by_kind: dict[tuple[str, Code], list[Finding]] = {(joint, code): [] for joint in joints for code in CODES}
    for each in found:
        by_kind[each.joint, each.code].append(each)
    notes: list[Diagnostic] = []
    errors: list[SpelgenError] = []
    for (joint, code), same in by_kind.items():
        if not same or (same[0].everywhere and len(same) < trajectories):
            continue
        others = f" (and in {len(same) - 1} more trajectories)" if len(same) > 1 else ""
        where = f"trajectory {same[0].trajectory}, joint {joint!r}"
        if code in ERRORS:
            expected, do = ERRORS[code]
            got = f"{same[0].what}{others}"
            errors.append(LogError(got, file=same[0].file, element=where, expected=expected, do=do))
        else:
            severity: Literal["info", "warning"] = "info" if code == "joint-at-rest" else "warning"
            notes.append(Diagnostic(severity, code, where, None, same[0].what + others))
    return notes, errors


def findings(
    trajectory: Trajectory,
    joints: Sequence[str],
    joint_types: Sequence[str],
    agreement: VelocityAgreement | None = None,
) -> list[Finding]:
    """What is odd about the joints of one trajectory. agreement: where it is known already."""
    agreement = velocity_agreement(trajectory) if agreement is None else agreement
    return [
        Finding(code, trajectory.name, trajectory.file, joint, what, everywhere)
        for index, (joint, kind) in enumerate(zip(joints, joint_types, strict=True))
        for code, what, everywhere in (
            *_constant(trajectory, index),
            *_velocity(trajectory, index, kind, agreement, joints),
        )
    ]


def velocity_agreement(trajectory: Trajectory) -> VelocityAgreement:
    """How far qd is dq/dt, within gap-free pieces."""
    n = trajectory.q.shape[1]
    total = VelocityAgreement(np.zeros(n), np.zeros(n), np.zeros((n, n)))
    for piece in split_at_gaps(trajectory):
        span = min(SPAN, len(piece.t) - 1)
        if span:
            steps = (piece.qd[1:] + piece.qd[:-1]) / 2 * np.diff(piece.t)[:, None]
            area = np.concatenate([np.zeros((1, n)), np.cumsum(steps, axis=0)])
            x, y = area[span:] - area[:-span], piece.q[span:] - piece.q[:-span]
            total += VelocityAgreement((x * x).sum(axis=0), (y * y).sum(axis=0), x.T @ y)
    return total


def _constant(trajectory: Trajectory, index: int) -> Iterator[tuple[Code, str, bool]]:
    """Columns that never change."""
    q, qd, tau = trajectory.q[:, index], trajectory.qd[:, index], trajectory.tau[:, index : index + 1]
    drift = np.abs(np.cumsum((qd[1:] + qd[:-1]) / 2 * np.diff(trajectory.t))).max(initial=0.0)
    if tau.size and np.ptp(tau) == 0:
        yield (
            "constant-torque",
            (f"tau is always {tau[0, 0]:g}: right for a joint without a motor only"),
            True,
        )
    if np.ptp(q) > 0 and np.ptp(qd) == 0 and np.ptp(q) > DRIFT:
        yield "frozen", f"qd always {qd[0]:g} while q goes from {q.min():.3g} to {q.max():.3g}", False
    elif np.ptp(q) == 0 and drift > DRIFT:
        yield "frozen", f"q always {q[0]:g} while qd says that it moves by {drift:.3g}", False
    elif np.ptp(q) == 0:
        yield "joint-at-rest", "does not move: the logs say nothing about its own dynamics", True


def _velocity(
    trajectory: Trajectory, index: int, kind: str, agreement: VelocityAgreement, joints: Sequence[str]
) -> Iterator[tuple[Code, str, bool]]:
    """Degrees, and velocities that are not the positions' derivative."""
    factor, correlation = agreement.factor(index), agreement.correlation(index)
    degrees = None
    if kind == "revolute" and not trajectory.declares_units:
        degrees = _degrees(trajectory.q[:, index], factor, correlation)
    if degrees:
        yield "degrees", degrees, False
    elif correlation is not None and (correlation < AGREEMENT or abs(factor - 1) > DEVIATION):
        yield (
            "velocity-is-no-derivative",
            (
                f"qd is not dq/dt: the best factor is {factor:.3g}, the correlation "
                f"{correlation:.3g}; {_advice(index, agreement, factor, correlation, joints)}"
            ),
            False,
        )


def _advice(
    index: int, agreement: VelocityAgreement, factor: float, correlation: float, joints: Sequence[str]
) -> str:
    fits = [
        joint
        for k, joint in enumerate(joints)
        if k != index and (agreement.correlation(index, k) or 0.0) > max(AGREEMENT, correlation)
    ]
    if fits:
        return f"it fits q of joint {fits[0]!r}"
    if abs(factor + 1) <= DEVIATION:
        return "its sign is the opposite of that of q"
    for unit, size in (("ms", 1e-3), ("us", 1e-6), ("ns", 1e-9)):
        if correlation > AGREEMENT and 0.8 < factor / size < 1.25:
            return f"are the times in {unit}?"
    return "check units, signs and the order of the joints"


def _degrees(q: np.ndarray, factor: float, correlation: float | None) -> str | None:
    """Why a revolute joint seems to be recorded in degrees: the numbers that say so."""
    agrees = correlation is not None and correlation > AGREEMENT
    if agrees and 0.8 < factor / DEGREES < 1.25:
        return f"q that changes {factor:.3g} times as fast as qd says (180/pi is 57.3)"
    if agrees and 0.8 < factor * DEGREES < 1.25:
        return f"qd that is {1 / factor:.3g} times as large as q changes (180/pi is 57.3)"
    if np.ptp(q) > 4 * np.pi:
        return f"q from {q.min():.3g} to {q.max():.3g}, more than two turns"
    return None
