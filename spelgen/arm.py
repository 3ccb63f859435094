"""Robot -> Arm: the serial chain, fixed and locked links lumped, mimic joints folded in, geometry exact."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from math import pi
from typing import Literal

import numpy as np

from spelgen.chain import Chain, Follow, choose_chain, follows
from spelgen.errors import ArmError, Diagnostic
from spelgen.placement import Placement, Pose, TenVector
from spelgen.rational import Matrix, Vector, exact, rotation_from_rpy, tamed
from spelgen.robot import Joint, Link, Robot
from spelgen.snapping import Snapper

Kind = Literal["revolute", "prismatic"]
# sine of the angle below which two axes are meant to be parallel, whatever rounding made of them
_PARALLEL = 1e-2


@dataclass(frozen=True)
class Coordinate:
    """One degree of freedom; limits as in the file (rad or m, N m or N, per second), None where absent."""

    name: str
    kind: Kind
    continuous: bool
    lower: float | None
    upper: float | None
    effort: float | None
    velocity: float | None
    damping: float
    friction: float
    passive: bool


@dataclass(frozen=True)
class Body:
    """A joint and all that moves rigidly with it.

    ``rotation`` and ``translation`` [m] are the pose of the joint's own frame in the parent body's (the root
    link's for parent -1) at zero position; the joint turns about, or slides along, the +z of its own frame by
    multiplier * q + offset, q the coordinate. ``inertia`` is (m, m c, Ixx, Ixy, Ixz, Iyy, Iyz, Izz) [kg, kg
    m, kg m2] about the joint frame's origin, in the joint frame; None where no link of the body has an
    inertial.
    """

    name: str
    kind: Kind
    parent: int
    coordinate: int
    multiplier: Fraction
    offset: float
    rotation: Matrix
    translation: Vector
    inertia: TenVector | None


@dataclass(frozen=True)
class Arm:
    """A serial arm with n coordinates, root first; ``bodies`` hold the chain in its order, parents first.

    ``gravity`` [m/s2] is in the root link's frame; ``locked`` names the joints held still; ``diagnostics``
    holds what this step did, the robot's own stay with the robot.
    """

    name: str
    coordinates: tuple[Coordinate, ...]
    bodies: tuple[Body, ...]
    gravity: Vector
    diagnostics: tuple[Diagnostic, ...]
    locked: tuple[str, ...]

    @property
    def has_inertials(self) -> bool:
        """Whether every body has an inertial with mass."""
        return all(body.inertia is not None and body.inertia[0] > 0 for body in self.bodies)


def make_arm(
    robot: Robot,
    *,
    joints: Sequence[str] | None = None,
    tip: str | None = None,
    snap_tolerance: float = 2e-3,
    gravity: Sequence[float] = (0.0, 0.0, -9.81),
) -> Arm:
    """Return the arm of the named ``joints``, up to the link ``tip``, or of the longest serial chain.

    All other joints are locked at 0.

    ``snap_tolerance`` [rad] is how far an angle may be from a multiple of pi/2 to be taken as one; 0 believes
    the file in everything. Raises ``ArmError``.
    """
    if not 0 <= snap_tolerance < pi / 4:
        got = f"a snap tolerance of {snap_tolerance:g} rad"
        raise ArmError(got, expected="at least 0 and less than pi/4 (0.785)")
    chain = choose_chain(robot, joints, tip)
    snapper = Snapper(snap_tolerance)
    placement = Placement(robot.root, snapper)
    indices = {joint.name: index for index, joint in enumerate(chain.joints)}
    moved: list[tuple[Joint, Follow, Pose]] = []
    held: list[Joint] = []
    following = follows(robot)
    for joint in _chain_first(robot, chain):
        followed = following[joint.name]
        if joint.moves and followed.leader.name in indices and followed.multiplier:
            moved.append((joint, followed, placement.move(joint)))
        else:
            held.append(joint)
            placement.hold(joint, float(followed.offset) if joint.moves else 0.0)
    lumps = _lumps(robot, placement, len(moved))
    bodies = tuple(
        _body(joint, followed, indices[followed.leader.name], pose, _total(placement, lump))
        for (joint, followed, pose), lump in zip(moved, lumps, strict=True)
    )
    told = [
        *chain.diagnostics,
        *snapper.diagnostics,
        *_tell_folded(moved),
        *_tell_lumped(moved, lumps),
        *_tell_locked(following, held),
        *_tell_dependent(placement, bodies, held),
    ]
    x, y, z = (exact(float(value)) for value in gravity)
    return Arm(
        name=robot.name,
        coordinates=tuple(_coordinate(joint) for joint in chain.joints),
        bodies=bodies,
        gravity=(x, y, z),
        diagnostics=tuple(sorted(told, key=lambda each: each.line or 0)),
        locked=tuple(joint.name for joint in robot.joints if joint in held and joint.type != "fixed"),
    )


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
            total = ten if total is None else tuple(tamed(a + b) for a, b in zip(total, ten, strict=True))
    return total


def _body(joint: Joint, followed: Follow, coordinate: int, pose: Pose, inertia: TenVector | None) -> Body:
    return Body(
        name=joint.name,
        kind=_kind(joint),
        parent=pose.parent,
        coordinate=coordinate,
        multiplier=followed.multiplier,
        offset=float(followed.offset),
        rotation=pose.rotation,
        translation=pose.translation,
        inertia=inertia,
    )


def _coordinate(joint: Joint) -> Coordinate:
    return Coordinate(
        name=joint.name,
        kind=_kind(joint),
        continuous=joint.type == "continuous",
        lower=joint.lower,
        upper=joint.upper,
        effort=joint.effort,
        velocity=joint.velocity,
        damping=joint.damping,
        friction=joint.friction,
        passive=False,
    )


def _kind(joint: Joint) -> Kind:
    return "prismatic" if joint.type == "prismatic" else "revolute"


def _info(code: str, joint: Joint, message: str) -> Diagnostic:
    return Diagnostic("info", code, f"joint {joint.name!r}", joint.line, message)


def _tell_folded(moved: Sequence[tuple[Joint, Follow, Pose]]) -> Iterator[Diagnostic]:
    for joint, followed, _ in moved:
        if joint.mimic is not None:
            offset = f" plus {float(followed.offset):g}" if followed.offset else ""
            message = f"moves at {float(followed.multiplier):g} times {followed.leader.name!r}{offset}"
            yield _info("mimic-folded", joint, message)


def _tell_lumped(
    moved: Sequence[tuple[Joint, Follow, Pose]], lumps: Sequence[Sequence[Link]]
) -> Iterator[Diagnostic]:
    for (joint, _, _), links in zip(moved, lumps, strict=True):
        others = [link for link in links if link.name != joint.child]
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
    placement: Placement, bodies: Sequence[Body], held: Sequence[Joint]
) -> Iterator[Diagnostic]:
    """A locked joint beside a joint of the chain and parallel to it smells of an opened parallelogram."""
    behind: set[str] = set()
    for joint in held:
        if joint.moves or joint.parent in behind:
            behind.add(joint.child)
        if joint.parent in behind or joint.type not in ("revolute", "continuous") or joint.mimic is not None:
            continue
        beside = _parallel_beside(placement, bodies, joint)
        if beside is not None:
            message = (
                f"turns parallel to {beside.name!r} beside it, and has no <mimic>: "
                "if a linkage couples the two, add one; locked at 0 until then"
            )
            yield Diagnostic("warning", "dependent-joints", f"joint {joint.name!r}", joint.line, message)


def _parallel_beside(placement: Placement, bodies: Sequence[Body], joint: Joint) -> Body | None:
    """The revolute body that starts from the same moving body as ``joint``, with a parallel axis."""
    frame = placement.frames[joint.parent]
    axis = np.array(joint.axis) / np.linalg.norm(joint.axis)
    axis = np.array(frame.rotation, dtype=float) @ rotation_from_rpy(joint.rpy) @ axis
    for body in bodies:
        if body.parent == frame.body >= 0 and body.kind == "revolute":
            other = np.array([float(row[2]) for row in body.rotation])
            if np.linalg.norm(np.cross(axis, other)) < _PARALLEL:
                return body
    return None
