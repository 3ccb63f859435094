"""Every joint sorted into what moves and what is held, the links lumped, and what to tell about it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from spelgen.arm.angle_rounding import AngleRounding
from spelgen.arm.chain import Chain, Follow, follows
from spelgen.arm.placement import Frame, Placement, Pose, TenVector
from spelgen.arm.rational import bounded, rotation_from_rpy
from spelgen.arm.tuning import TUNING
from spelgen.errors import Diagnostic
from spelgen.urdf.robot import Joint, Link, Robot


@dataclass(frozen=True)
class Moved:
    """Hold a joint that moves, what it follows, where it is, and the ``links`` it carries with their inertia."""

    joint: Joint
    followed: Follow
    pose: Pose
    links: tuple[Link, ...]
    inertia: TenVector | None


@dataclass(frozen=True)
class LumpedLinks:
    """Hold all joints: those that move, the chain's first, and those held still, fixed ones included.

    frames: of all links, by name.
    """

    moved: tuple[Moved, ...]
    held: tuple[Joint, ...]
    frames: Mapping[str, Frame]
    diagnostics: tuple[Diagnostic, ...]


def lump_links(robot: Robot, chain: Chain, angle_tolerance: float) -> LumpedLinks:
    """Return the robot with the chain's joints and their followers moving, and all others held."""
    rounding = AngleRounding(angle_tolerance)
    # parents first: a link is placed in the frame of the body that carries it
    placement = Placement(robot.root, rounding)
    following = follows(robot)
    poses: list[tuple[Joint, Pose]] = []
    held: list[Joint] = []
    for joint in _chain_first(robot, chain):
        followed = following[joint.name]
        if joint.moves and followed.leader.name in chain.names and followed.multiplier:
            poses.append((joint, placement.move(joint)))
        else:
            # a follower whose leader is held stands at its offset, all other joints at 0
            held.append(joint)
            placement.hold(joint, float(followed.offset) if joint.moves else 0.0)
    moved = []
    for (joint, pose), links in zip(poses, _lumps(robot, placement, len(poses)), strict=True):
        moved.append(Moved(joint, following[joint.name], pose, tuple(links), _total(placement, links)))
    diagnostics = [
        *chain.diagnostics,
        *rounding.diagnostics,
        *_folded_remarks(moved),
        *_lumped_remarks(moved),
        *_locked_remarks(following, held),
        *_dependent_remarks(placement, moved, held),
    ]
    diagnostics.sort(key=lambda diagnostic: diagnostic.line or 0)
    return LumpedLinks(tuple(moved), tuple(held), placement.frames, tuple(diagnostics))


def _chain_first(robot: Robot, chain: Chain) -> list[Joint]:
    """Return all joints, parents first, those on the way to the chain's tip before all others."""
    path = robot.path_to(chain.joints[-1].child)
    # bodies are numbered in this order, so the chain's come first and followers after them
    return list(dict.fromkeys([*path, *robot.joints_from_root]))


def _lumps(robot: Robot, placement: Placement, count: int) -> list[list[Link]]:
    """Return the links with an inertial that each body carries; what the root carries never moves."""
    lumps: list[list[Link]] = [[] for _ in range(count)]
    # what the root carries never moves, and a link without inertial adds nothing
    for link in robot.links:
        body = placement.frames[link.name].body
        if body >= 0 and link.inertial is not None:
            lumps[body].append(link)
    return lumps


def _total(placement: Placement, links: Sequence[Link]) -> TenVector | None:
    """Return the sum of the links' inertias about their body's origin."""
    total: TenVector | None = None
    for link in links:
        if link.inertial is not None:
            ten = placement.inertia(link, link.inertial)
            total = ten if total is None else tuple(bounded(a + b) for a, b in zip(total, ten, strict=True))
    return total


def _info(code: str, joint: Joint, message: str) -> Diagnostic:
    return Diagnostic("info", code, f"joint {joint.name!r}", joint.line, message)


def _folded_remarks(moved: Sequence[Moved]) -> Iterator[Diagnostic]:
    for body in moved:
        if body.joint.mimic is not None:
            followed = body.followed
            message = f"moves at {float(followed.multiplier):g} times {followed.leader.name!r}"
            if followed.offset:
                message += f" plus {float(followed.offset):g}"
            yield _info("mimic-folded", body.joint, message)


def _lumped_remarks(moved: Sequence[Moved]) -> Iterator[Diagnostic]:
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


def _locked_remarks(following: Mapping[str, Follow], held: Sequence[Joint]) -> Iterator[Diagnostic]:
    # a humanoid has thirty of them: one remark for all
    outside = [joint for joint in held if joint.moves and joint.mimic is None]
    if outside:
        names = ", ".join(repr(joint.name) for joint in outside)
        message = f"locked at 0, not part of the chain: {names}"
        yield Diagnostic("info", "locked-joint", "joints", outside[0].line, message)
    for joint in held:
        if joint.type == "fixed" or joint in outside:
            continue
        followed = following[joint.name]
        if joint.mimic is not None:
            message = f"follows {followed.leader.name!r}: locked at {float(followed.offset):g}"
        else:
            message = f"a {joint.type} joint that is not part of the chain: fixed at its origin"
        yield _info("locked-joint", joint, message)


def _dependent_remarks(
    placement: Placement, moved: Sequence[Moved], held: Sequence[Joint]
) -> Iterator[Diagnostic]:
    """Say which locked joints are parallel to one of the chain beside them.

    A locked joint beside a joint of the chain and parallel to it is the mark of an opened parallelogram.
    """
    behind: set[str] = set()
    for joint in held:
        if joint.moves or joint.parent in behind:
            behind.add(joint.child)
        turns = joint.type in ("revolute", "continuous") and joint.mimic is None
        # behind a locked joint the arm's own geometry says nothing any more
        if joint.parent in behind or not turns:
            continue
        beside = _parallel_beside(placement, moved, joint)
        if beside is not None:
            message = (
                f"turns parallel to {beside.name!r} beside it, and has no <mimic>: "
                "if a linkage couples the two, add one; locked at 0 until then"
            )
            yield Diagnostic("warning", "dependent-joints", f"joint {joint.name!r}", joint.line, message)


def _parallel_beside(placement: Placement, moved: Sequence[Moved], joint: Joint) -> Joint | None:
    """Return the revolute joint that starts from the same moving body as ``joint``, with a parallel axis."""
    frame = placement.frames[joint.parent]
    rotation = np.array(frame.rotation, dtype=float) @ rotation_from_rpy(joint.rpy)
    axis = rotation @ np.array(joint.axis) / np.linalg.norm(joint.axis)
    for body in moved:
        if body.pose.parent == frame.body >= 0 and body.joint.type != "prismatic":
            # a body turns about the +z of its own frame
            beside = np.array(body.pose.rotation, dtype=float)[:, 2]
            if np.linalg.norm(np.cross(axis, beside)) < TUNING.parallel:
                return body.joint
    return None
