"""Every joint sorted into what moves and what is held, the links lumped, and what to tell about it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from spelgen.arm.angle_rounding import AngleRounding
from spelgen.arm.chain import Chain, Follow, follows
from spelgen.arm.placement import Placement, Pose, TenVector
from spelgen.arm.rational import bounded, rotation_from_rpy
from spelgen.errors import Diagnostic
from spelgen.urdf.robot import Joint, Link, Robot

# sine of the angle below which two axes are meant to be parallel, whatever rounding made of them
_PARALLEL = 1e-2


@dataclass(frozen=True)
class Moved:
    """A joint that moves, what it follows, where it is, and the ``links`` it carries with their inertia."""

    joint: Joint
    followed: Follow
    pose: Pose
    links: tuple[Link, ...]
    inertia: TenVector | None


@dataclass(frozen=True)
class LumpedLinks:
    """All joints: those that move, the chain's first, and those held still, fixed ones included."""

    moved: tuple[Moved, ...]
    held: tuple[Joint, ...]
    diagnostics: tuple[Diagnostic, ...]


def lump_links(robot: Robot, chain: Chain, angle_tolerance: float) -> LumpedLinks:
    """Return the robot with the chain's joints and their followers moving, and all others held."""
    rounding = AngleRounding(angle_tolerance)
    placement = Placement(robot.root, rounding)
    following = follows(robot)
    leaders = {joint.name for joint in chain.joints}
    poses: list[tuple[Joint, Pose]] = []
    held: list[Joint] = []
    for joint in _chain_first(robot, chain):
        followed = following[joint.name]
        if joint.moves and followed.leader.name in leaders and followed.multiplier:
            poses.append((joint, placement.move(joint)))
        else:
            held.append(joint)
            placement.hold(joint, float(followed.offset) if joint.moves else 0.0)
    moved = tuple(
        Moved(joint, following[joint.name], pose, tuple(links), _total(placement, links))
        for (joint, pose), links in zip(poses, _lumps(robot, placement, len(poses)), strict=True)
    )
    told = [
        *chain.diagnostics,
        *rounding.diagnostics,
        *_tell_folded(moved),
        *_tell_lumped(moved),
        *_tell_locked(following, held),
        *_tell_dependent(placement, moved, held),
    ]
    return LumpedLinks(moved, tuple(held), tuple(sorted(told, key=lambda each: each.line or 0)))


def _chain_first(robot: Robot, chain: Chain) -> list[Joint]:
    """All joints, parents first, those on the way to the chain's tip before all others."""
    path = robot.path_to(chain.joints[-1].child)
    names = {joint.name for joint in path}
    return [*path, *(joint for joint in robot.joints_from_root if joint.name not in names)]


def _lumps(robot: Robot, placement: Placement, count: int) -> list[list[Link]]:
    """The links with an inertial that each body carries; what the root carries never moves."""
    lumps: list[list[Link]] = [[] for _ in range(count)]
    for link in robot.links:
        body = placement.frames[link.name].body
        if body >= 0 and link.inertial is not None:
            lumps[body].append(link)
    return lumps


def _total(placement: Placement, links: Sequence[Link]) -> TenVector | None:
    """The sum of the links' inertias about their body's origin."""
    total: TenVector | None = None
    for link in links:
        if link.inertial is not None:
            ten = placement.inertia(link, link.inertial)
            total = ten if total is None else tuple(bounded(a + b) for a, b in zip(total, ten, strict=True))
    return total


def _info(code: str, joint: Joint, message: str) -> Diagnostic:
    return Diagnostic("info", code, f"joint {joint.name!r}", joint.line, message)


def _tell_folded(moved: Sequence[Moved]) -> Iterator[Diagnostic]:
    for each in moved:
        joint, followed = each.joint, each.followed
        if joint.mimic is not None:
            offset = f" plus {float(followed.offset):g}" if followed.offset else ""
            message = f"moves at {float(followed.multiplier):g} times {followed.leader.name!r}{offset}"
            yield _info("mimic-folded", joint, message)


def _tell_lumped(moved: Sequence[Moved]) -> Iterator[Diagnostic]:
    for each in moved:
        joint = each.joint
        others = [link for link in each.links if link.name != joint.child]
        if others:
            mass = sum(link.inertial.mass for link in others if link.inertial is not None)
            listed = ", ".join(repr(link.name) for link in others)
            message = f"also carries {listed} ({mass:.4g} kg) by fixed or locked joints"
            yield _info("lumped", joint, message)


def _tell_locked(following: Mapping[str, Follow], held: Sequence[Joint]) -> Iterator[Diagnostic]:
    for joint in held:
        if joint.type == "fixed":
            continue
        followed = following[joint.name]
        if joint.mimic is not None:
            message = f"follows {followed.leader.name!r}: held at {float(followed.offset):g}"
        elif joint.moves:
            message = "not part of the chain: locked at 0"
        else:
            message = f"a {joint.type} joint off the chain: held at its origin"
        yield _info("locked-joint", joint, message)


def _tell_dependent(
    placement: Placement, moved: Sequence[Moved], held: Sequence[Joint]
) -> Iterator[Diagnostic]:
    """A locked joint beside a joint of the chain and parallel to it smells of an opened parallelogram."""
    behind: set[str] = set()
    for joint in held:
        if joint.moves or joint.parent in behind:
            behind.add(joint.child)
        if joint.parent in behind or joint.type not in ("revolute", "continuous") or joint.mimic is not None:
            continue
        beside = _parallel_beside(placement, moved, joint)
        if beside is not None:
            message = (
                f"turns parallel to {beside.name!r} beside it, and has no <mimic>: "
                "if a linkage couples the two, add one; locked at 0 until then"
            )
            yield Diagnostic("warning", "dependent-joints", f"joint {joint.name!r}", joint.line, message)


def _parallel_beside(placement: Placement, moved: Sequence[Moved], joint: Joint) -> Joint | None:
    """The revolute joint that starts from the same moving body as ``joint``, with a parallel axis."""
    frame = placement.frames[joint.parent]
    axis = np.array(joint.axis) / np.linalg.norm(joint.axis)
    axis = np.array(frame.rotation, dtype=float) @ rotation_from_rpy(joint.rpy) @ axis
    for each in moved:
        if each.pose.parent == frame.body >= 0 and each.joint.type != "prismatic":
            other = np.array([float(row[2]) for row in each.pose.rotation])
            if np.linalg.norm(np.cross(axis, other)) < _PARALLEL:
                return each.joint
    return None
