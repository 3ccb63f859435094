"""Classification of all joints as moving or locked, lumping of links into bodies, and diagnostics."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from spelgen.arm.angle_rounding import AngleRounding
from spelgen.arm.chain import ChainChoice, Leader, leaders
from spelgen.arm.placement import Frame, Placement, Pose, TenVector
from spelgen.arm.rational import bounded, rotation_from_rpy
from spelgen.arm.tuning import TUNING
from spelgen.errors import Diagnostic
from spelgen.urdf.robot import Robot, UrdfJoint, UrdfLink


@dataclass(frozen=True)
class MovingJoint:
    """A moving joint with its leader and pose, and the ``links`` of its body with their total inertia."""

    joint: UrdfJoint
    followed: Leader
    pose: Pose
    links: tuple[UrdfLink, ...]
    inertia: TenVector | None


@dataclass(frozen=True)
class LumpedLinks:
    """Moving joints (the chain first), locked joints (fixed ones included), and the frames of all links by name."""

    moved: tuple[MovingJoint, ...]
    locked: tuple[UrdfJoint, ...]
    frames: Mapping[str, Frame]
    diagnostics: tuple[Diagnostic, ...]


def lump_links(robot: Robot, chain: ChainChoice, angle_tolerance: float) -> LumpedLinks:
    """Return the robot with moving joints of the chain and their followers, and all other joints locked."""
    rounding = AngleRounding(angle_tolerance)
    placement = Placement(robot.root, rounding)
    # Chains of mimic joints are resolved to the joint that leads them, with products of the multipliers.
    following = leaders(robot)
    poses: list[tuple[UrdfJoint, Pose]] = []
    locked: list[UrdfJoint] = []
    # bodies have this order: parents first, and the chain before followers on branches
    path = robot.path_to(chain.joints[-1].child)
    for joint in dict.fromkeys([*path, *robot.joints_from_root]):
        followed = following[joint.name]
        if joint.moves and followed.leader.name in chain.names and followed.multiplier:
            poses.append((joint, placement.move(joint)))
        else:
            # the position of a follower of a locked joint is its offset
            locked.append(joint)
            placement.lock(joint, float(followed.offset) if joint.moves else 0.0)
    moved = []
    for (joint, pose), links in zip(poses, _lumps(robot, placement, len(poses)), strict=True):
        total = _total(placement, links)
        moved.append(MovingJoint(joint, following[joint.name], pose, tuple(links), total))
    diagnostics = [
        *chain.diagnostics,
        *rounding.diagnostics,
        *_folded_remarks(moved),
        *_lumped_remarks(moved),
        *_locked_remarks(following, locked),
        *_dependent_remarks(placement, moved, locked),
    ]
    diagnostics.sort(key=lambda diagnostic: diagnostic.line or 0)
    return LumpedLinks(tuple(moved), tuple(locked), placement.frames, tuple(diagnostics))


def _lumps(robot: Robot, placement: Placement, count: int) -> list[list[UrdfLink]]:
    """Return the links with an inertial for each body; links that are fixed to the root do not move."""
    # Links that locked joints connect move together: M and V depend on the sum of their inertias only.
    lumps: list[list[UrdfLink]] = [[] for _ in range(count)]
    for link in robot.links:
        body = placement.frames[link.name].body
        if body >= 0 and link.inertial is not None:
            lumps[body].append(link)
    return lumps


def _total(placement: Placement, links: Sequence[UrdfLink]) -> TenVector | None:
    """Return the sum of the inertias of links about the origin of their body."""
    total: TenVector | None = None
    for link in links:
        if link.inertial is not None:
            ten = placement.inertia(link, link.inertial)
            total = ten if total is None else tuple(bounded(a + b) for a, b in zip(total, ten, strict=True))
    return total


def _info(code: str, joint: UrdfJoint, message: str) -> Diagnostic:
    return Diagnostic("info", code, f"joint {joint.name!r}", joint.line, message)


def _folded_remarks(moved: Sequence[MovingJoint]) -> Iterator[Diagnostic]:
    for body in moved:
        if body.joint.mimic is not None:
            followed = body.followed
            message = f"moves at {float(followed.multiplier):g} times {followed.leader.name!r}"
            if followed.offset:
                message += f" plus {float(followed.offset):g}"
            yield _info("mimic-folded", body.joint, message)


def _lumped_remarks(moved: Sequence[MovingJoint]) -> Iterator[Diagnostic]:
    for body in moved:
        names = []
        mass = 0.0
        for link in body.links:
            if link.name != body.joint.child and link.inertial is not None:
                names.append(repr(link.name))
                mass += link.inertial.mass
        if names:
            message = f"also carries {', '.join(names)} ({mass:.4g} kg) by fixed or locked joints"
            yield _info("lumped", body.joint, message)


def _locked_remarks(following: Mapping[str, Leader], locked: Sequence[UrdfJoint]) -> Iterator[Diagnostic]:
    # one remark for all: a humanoid has thirty locked joints
    outside = [joint for joint in locked if joint.moves and joint.mimic is None]
    if outside:
        names = ", ".join(repr(joint.name) for joint in outside)
        message = f"locked at 0, not part of the chain: {names}"
        yield Diagnostic("info", "locked-joint", "joints", outside[0].line, message)
    for joint in locked:
        if joint.type == "fixed" or joint in outside:
            continue
        followed = following[joint.name]
        if joint.mimic is not None:
            message = f"follows {followed.leader.name!r}: locked at {float(followed.offset):g}"
        else:
            message = f"a {joint.type} joint that is not part of the chain: fixed at its origin"
        yield _info("locked-joint", joint, message)


def _dependent_remarks(
    placement: Placement, moved: Sequence[MovingJoint], locked: Sequence[UrdfJoint]
) -> Iterator[Diagnostic]:
    """Yield a warning for each locked joint that is parallel to a joint of the chain with the same parent body.

    Such a pair indicates a parallelogram linkage whose loop was opened in the URDF.
    """
    behind: set[str] = set()
    for joint in locked:
        if joint.moves or joint.parent in behind:
            behind.add(joint.child)
        turns = joint.type in ("revolute", "continuous") and joint.mimic is None
        # joints behind a locked joint are not part of a linkage of the arm
        if joint.parent in behind or not turns:
            continue
        beside = _parallel_beside(placement, moved, joint)
        if beside is not None:
            message = (
                f"turns parallel to {beside.name!r} beside it, and has no <mimic>: "
                "if a linkage couples the two, add one; locked at 0 until then"
            )
            yield Diagnostic("warning", "dependent-joints", f"joint {joint.name!r}", joint.line, message)


def _parallel_beside(
    placement: Placement, moved: Sequence[MovingJoint], joint: UrdfJoint
) -> UrdfJoint | None:
    """Return the revolute joint with the same parent body as ``joint`` and a parallel axis; None if there is none."""
    frame = placement.frames[joint.parent]
    rotation = np.array(frame.rotation, dtype=float) @ rotation_from_rpy(joint.rpy)
    axis = rotation @ np.array(joint.axis) / np.linalg.norm(joint.axis)
    for body in moved:
        if body.pose.parent == frame.body >= 0 and body.joint.type != "prismatic":
            # a body rotates about the z axis of its frame
            beside = np.array(body.pose.rotation, dtype=float)[:, 2]
            if np.linalg.norm(np.cross(axis, beside)) < TUNING.parallel:
                return body.joint
    return None
