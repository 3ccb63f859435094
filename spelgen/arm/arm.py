"""Derive a `Chain` from a `Robot`: a serial chain with exact geometry.

Links that move rigidly together are lumped into bodies.
"""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from math import pi
from typing import NamedTuple

import numpy as np

from spelgen.arm.chain import ChainChoice, Leader, choose_chain, leaders
from spelgen.arm.placement import AngleRounding, Frame, Placement, TenVector
from spelgen.arm.rational import Matrix, Vector, bounded, exact, rotation_from_rpy
from spelgen.errors import ArmError, Diagnostic
from spelgen.urdf.robot import JointType, Robot, UrdfJoint, UrdfLink


class Coordinate(NamedTuple):
    """A degree of freedom: a joint with its limits, damping and friction in the URDF. An absent limit is None.

    ``lower``, ``upper`` [rad, m]; ``effort`` [Nm, N]; ``velocity`` [rad/s, m/s]; ``damping`` [Nm s/rad, N s/m];
    ``friction`` [Nm, N]. ``passive``: whether the joint has no actuator.
    """

    name: str
    joint_type: JointType
    continuous: bool
    lower: float | None
    upper: float | None
    effort: float | None
    velocity: float | None
    damping: float
    friction: float
    passive: bool

    @property
    def limits(self) -> tuple[float, float] | None:
        """Lower and upper limit [rad, m]; None if one of the two is absent, as for continuous joints."""
        if self.lower is None or self.upper is None:
            return None
        return self.lower, self.upper

    @property
    def working_range(self) -> tuple[float, float]:
        """Lower and upper end of the range for random positions [rad, m].

        The range is given by the limits, cut at +-2 pi for a revolute joint. Without usable limits it is one
        revolution, or 1 m, about zero.
        """
        is_revolute, limits = self.joint_type == "revolute", self.limits
        # Huge or equal limits are not usable as a range: exporters write +-1e16, or equal limits, for a joint without
        # limits.
        if limits is None or not 0 < limits[1] - limits[0] < 1e3:
            half_range = pi if is_revolute else 0.5
            return -half_range, half_range
        return (max(limits[0], -2 * pi), min(limits[1], 2 * pi)) if is_revolute else limits


@dataclass(frozen=True)
class Body:
    """A joint and all links that move rigidly with the child link of the joint.

    ``name`` is the name of the joint, ``link`` the name of its child link. ``parent`` is the index of the parent body,
    -1 for the root link. ``rotation`` and ``translation`` [m] are the pose of the joint's frame in the frame of the
    parent body at zero position. The joint rotates about, or translates along, the z axis of its frame by multiplier *
    q + offset [rad, m], where q is the position of the coordinate with the index ``coordinate``. ``inertia`` is (m, m
    c, Ixx, Ixy, Ixz, Iyy, Iyz, Izz) [kg, kg m, kg m^2] about the origin of the joint's frame, in this frame; None if no
    link of the body has an inertial.
    """

    name: str
    link: str
    joint_type: JointType
    parent: int
    coordinate: int
    multiplier: Fraction
    offset: float
    rotation: Matrix
    translation: Vector
    inertia: TenVector | None


@dataclass(frozen=True)
class Chain:
    """A serial arm with n coordinates from the root to the tip; parents precede their children in ``bodies``.

    ``gravity`` [m/s2] is in the frame of the root link. ``locked`` are the names of the locked joints, in the order of
    the URDF. ``diagnostics`` are about the choice of the joints and the lumping of links; diagnostics of the URDF are
    not included.
    """

    name: str
    coordinates: tuple[Coordinate, ...]
    bodies: tuple[Body, ...]
    gravity: Vector
    diagnostics: tuple[Diagnostic, ...]
    locked: tuple[str, ...]

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the joints that are the n coordinates, as in the URDF."""
        return tuple(coordinate.name for coordinate in self.coordinates)

    @property
    def joint_types(self) -> tuple[JointType, ...]:
        """Types of the joints that are the n coordinates, "revolute" or "prismatic"."""
        return tuple(coordinate.joint_type for coordinate in self.coordinates)

    @property
    def load_body(self) -> int:
        """Index of the body of the last joint, which carries payloads.

        Bodies of mimic joints on other branches, such as the cylinder of a counterweight, may have higher indices.
        """
        return next(k for k, body in enumerate(self.bodies) if body.coordinate == len(self.coordinates) - 1)

    @property
    def inertials_complete(self) -> bool:
        """Whether every body has an inertial with mass."""
        return all(body.inertia is not None and body.inertia[0] > 0 for body in self.bodies)

    @property
    def masses_are_copied(self) -> bool:
        """Whether two thirds of the bodies with mass, and at least three, have the same mass: a placeholder.

        It is true of 14 of 189 URDFs of real arms; true masses are up to 500 times as large.
        """
        masses = [body.inertia[0] for body in self.bodies if body.inertia and body.inertia[0] > 0]
        equal = max(map(masses.count, masses), default=0)
        return equal >= 3 and 3 * equal >= 2 * len(masses)


class MovingJoint(NamedTuple):
    """A moving joint of the URDF, its body in the chain, and the links of this body that have an inertial."""

    joint: UrdfJoint
    links: tuple[UrdfLink, ...]
    body: Body


class LumpedLinks(NamedTuple):
    """Result of `lump_links`: moving joints with their bodies, locked joints, and the frames of all links by name.

    ``moved``: the joints on the path to the tip, followed by mimic joints on other branches. ``locked`` includes fixed
    joints. ``frames``: poses of the links at zero position, in the frames of their bodies.
    """

    moved: tuple[MovingJoint, ...]
    locked: tuple[UrdfJoint, ...]
    frames: Mapping[str, Frame]
    diagnostics: tuple[Diagnostic, ...]


def make_arm(
    robot: Robot,
    *,
    joints: Sequence[str] | None = None,
    tip: str | None = None,
    angle_tolerance: float = 2e-3,
    gravity: Sequence[float] = (0.0, 0.0, -9.81),
    passive: Collection[str] = (),
) -> Chain:
    """Return an arm of a robot; all joints that are not part of the arm are locked at 0.

    Args:
        robot: the robot.
        joints: names of the moving joints.
        tip: name of the last link, in place of ``joints``. Without ``joints`` and ``tip``, the arm is the longest
            serial chain.
        angle_tolerance: angles [rad] that differ from a multiple of pi/2 by at most this tolerance are rounded to the
            multiple; 0: no angle is rounded.
        gravity: acceleration of gravity in the frame of the root link [m/s2].
        passive: names of the joints without an actuator.

    Raises ArmError.
    """
    if not 0 <= angle_tolerance < pi / 4:
        got = f"an angle tolerance of {angle_tolerance:g} rad"
        raise ArmError(got, expected="at least 0 and less than pi/4 (0.785)")
    chain = choose_chain(robot, joints, tip)
    _require_small(robot, chain)
    lumped = lump_links(robot, chain, angle_tolerance)
    locked = {joint.name for joint in lumped.locked if joint.type != "fixed"}
    # The gravity vector is converted to fractions, so that the gravity torque about a vertical axis is 0 and not 1e-17.
    x, y, z = map(exact, map(float, gravity))
    return Chain(
        name=robot.name,
        coordinates=tuple(_coordinate(joint, joint.name in passive) for joint in chain.joints),
        bodies=tuple(moving.body for moving in lumped.moved),
        gravity=(x, y, z),
        diagnostics=lumped.diagnostics,
        locked=tuple(joint.name for joint in robot.joints if joint.name in locked),
    )


def _require_small(robot: Robot, chain: ChainChoice) -> None:
    """Raise ArmError for more than 16 joints or 48 mimic joints, whose structure would take too long to derive."""
    # The time to derive the structure of an arm increases with about the fifth power of the number of joints.
    moving, largest, most_followers = len(chain.joints), 16, 48
    if moving > largest:
        do = "choose fewer with --joints or --tip"
        raise ArmError(f"{moving} joints", file=robot.source, expected=f"at most {largest}", do=do)
    # `following` is the number of mimic joints of the chain, which are separate bodies in the derivation. The sum
    # counts all joints whose leader is in the chain. A joint of the chain is its own leader and is counted, too: the
    # number of these joints is subtracted.
    following = sum(x.leader.name in chain.names for x in leaders(robot).values()) - moving
    if following > most_followers:
        got = f"{following} joints that follow others by <mimic>"
        raise ArmError(got, file=robot.source, expected=f"at most {most_followers}", do="fix some of them")


def _coordinate(joint: UrdfJoint, passive: bool) -> Coordinate:
    limits = *(joint.limits or (joint.lower, joint.upper)), joint.effort, joint.velocity
    is_continuous = joint.type == "continuous"
    friction = joint.damping, joint.friction
    return Coordinate(joint.name, _joint_type(joint), is_continuous, *limits, *friction, passive)


def _joint_type(joint: UrdfJoint) -> JointType:
    return "prismatic" if joint.type == "prismatic" else "revolute"


def lump_links(robot: Robot, chain: ChainChoice, angle_tolerance: float) -> LumpedLinks:
    """Lump links that move together into bodies: one per joint of the chain and per mimic joint of such a joint.

    All other joints are locked. A body belongs to one joint of the chain, or to one mimic joint that follows such a
    joint.

    angle_tolerance: angles [rad] that differ from a multiple of pi/2 by at most this tolerance are rounded to the
    multiple.
    """
    rounding = AngleRounding(angle_tolerance)
    placement = Placement(robot.root, rounding)
    # A mimic joint may mimic another mimic joint: `leaders` returns the joint without <mimic> at the end of such a
    # sequence, and the product of all multipliers.
    following = leaders(robot)
    poses = []
    locked: list[UrdfJoint] = []
    # The bodies are ordered with parents first, and joints of the chain before mimic joints on other branches.
    path = robot.path_to(chain.joints[-1].child)
    for joint in dict.fromkeys([*path, *robot.joints_from_root]):
        followed = following[joint.name]
        if joint.moves and followed.leader.name in chain.names and followed.multiplier:
            poses.append((joint, *placement.move(joint)))
        else:
            # A locked joint is locked at 0. A mimic joint whose leader is locked is locked at the offset of its
            # <mimic>.
            locked.append(joint)
            placement.lock(joint, float(followed.offset) if joint.moves else 0.0)
    moved = []
    for index, (joint, parent, rotation, translation) in enumerate(poses):
        followed = following[joint.name]
        # Links that move together are one body: M and V depend only on the sum of their inertias.
        links = tuple(x for x in robot.links if x.inertial and placement.frames[x.name].body == index)
        body = Body(
            name=joint.name,
            link=joint.child,
            joint_type=_joint_type(joint),
            parent=parent,
            coordinate=chain.names.index(followed.leader.name),
            multiplier=followed.multiplier,
            offset=float(followed.offset),
            rotation=tuple(map(tuple, rotation)),
            translation=tuple(translation),
            inertia=_total(placement, links),
        )
        moved.append(MovingJoint(joint, links, body))
    diagnostics = [
        *chain.diagnostics,
        *rounding.diagnostics,
        *_moved_remarks(moved, following),
        *_locked_remarks(following, locked),
        *_dependent_remarks(placement, moved, locked),
    ]
    diagnostics.sort(key=lambda diagnostic: diagnostic.line or 0)
    return LumpedLinks(tuple(moved), tuple(locked), placement.frames, tuple(diagnostics))


def _total(placement: Placement, links: Sequence[UrdfLink]) -> TenVector | None:
    """Return the sum of the inertial parameters (m, m c, I) of the links of one body, (10,) [kg, kg m, kg m2].

    The result is in the frame of the body; ``placement`` has the pose of each link in this frame. None if no link has
    an <inertial>.
    """
    tens = [placement.inertia(link, link.inertial) for link in links if link.inertial]
    if not tens:
        return None
    total = tens[0]
    # The number of digits of the fractions is bounded after each sum: in a malformed file it could grow with every
    # link.
    for ten in tens[1:]:
        total = tuple(bounded(a + b) for a, b in zip(total, ten, strict=True))
    return total


def _remark(code: str, joint: UrdfJoint, message: str) -> Diagnostic:
    return Diagnostic("info", code, f"joint {joint.name!r}", joint.line, message)


def _moved_remarks(moved: Sequence[MovingJoint], following: Mapping[str, Leader]) -> Iterator[Diagnostic]:
    for moving in moved:
        joint, followed = moving.joint, following[moving.joint.name]
        if joint.mimic is not None:
            message = f"moves at {float(followed.multiplier):g} times {followed.leader.name!r}"
            if followed.offset:
                message += f" plus {float(followed.offset):g}"
            yield _remark("mimic-folded", joint, message)
        carried = {
            repr(x.name): x.inertial.mass for x in moving.links if x.inertial and x.name != joint.child
        }
        if carried:
            mass = sum(carried.values())
            message = f"also carries {', '.join(carried)} ({mass:.4g} kg) by fixed or locked joints"
            yield _remark("lumped", joint, message)


def _locked_remarks(following: Mapping[str, Leader], locked: Sequence[UrdfJoint]) -> Iterator[Diagnostic]:
    # One remark lists all locked joints, because a humanoid robot has about thirty locked joints.
    outside = [joint for joint in locked if joint.moves and joint.mimic is None]
    if outside:
        # The model locks each of these joints at 0. A joint whose limits exclude 0 is never there on the real arm,
        # which therefore has another inertia than the model: the remark states this.
        limits = [joint.safe_limits or (0.0, 0.0) for joint in outside]
        names = ", ".join(
            repr(joint.name) + (" (0 is outside its limits)" if low > 0 or high < 0 else "")
            for joint, (low, high) in zip(outside, limits, strict=True)
        )
        message = f"locked at 0, not part of the chain: {names}"
        yield Diagnostic("info", "locked-joint", "joints", outside[0].line, message)
    for joint in locked:
        if joint.type == "fixed" or joint in outside:
            continue
        followed = following[joint.name]
        message = f"a {joint.type} joint that is not part of the chain: fixed at its origin"
        if joint.mimic is not None:
            message = f"follows {followed.leader.name!r}: locked at {float(followed.offset):g}"
        yield _remark("locked-joint", joint, message)


def _dependent_remarks(
    placement: Placement, moved: Sequence[MovingJoint], locked: Sequence[UrdfJoint]
) -> Iterator[Diagnostic]:
    """Yield a warning for each locked joint that may be part of a parallelogram linkage of the arm.

    URDF has no closed loops, so the closed loop of a linkage is cut at a joint. Two revolute joints then have the same
    parent body and parallel axes: one is in the chain (``moved``), the other is locked. placement: poses of the links
    in their bodies.
    """
    roots: dict[str, str] = {}  # {link: first link of its branch}, to group joints by branch
    branches: dict[str, list[UrdfJoint]] = {}
    for joint in locked:
        if joint.moves or joint.parent in roots:
            root = roots[joint.child] = roots.get(joint.parent, joint.child)
            branches.setdefault(root, []).extend([joint] * joint.moves)
    for branch in branches.values():
        joint, axes = branch[0], [_axis(placement.frames[x.parent], x) for x in branch]
        if joint.mimic is not None or any(x.type not in ("revolute", "continuous") for x in branch):
            continue
        beside = _parallel_beside(placement.frames[joint.parent], moved, axes[0])
        # The joints of a linkage have parallel axes. A branch with other axes, such as a head that pans and tilts, is
        # no linkage and causes no warning.
        if beside and all(_are_parallel(axes[0], axis) for axis in axes):
            message = (
                f"turns parallel to {beside[0]!r} beside it, and has no <mimic>: "
                "if a linkage couples the two, add one; locked at 0 until then"
            )
            yield Diagnostic("warning", "dependent-joints", f"joint {joint.name!r}", joint.line, message)


def _axis(frame: Frame, joint: UrdfJoint) -> np.ndarray:
    """Return the direction (3,) of a joint's axis in the frame of the body that carries its parent link.

    frame: pose of the parent link in the frame of this body.
    """
    rotation = np.array(frame.rotation, dtype=float) @ rotation_from_rpy(joint.rpy)
    return np.asarray(rotation @ np.array(joint.axis) / np.linalg.norm(joint.axis))


def _are_parallel(axis: np.ndarray, other: np.ndarray) -> bool:
    """Return True if the angle between two directions (3,) is below 0.01 rad: axes in URDFs are rounded."""
    return bool(np.linalg.norm(np.cross(axis, other)) < 1e-2)


def _parallel_beside(frame: Frame, moved: Sequence[MovingJoint], axis: np.ndarray) -> list[str]:
    """Return the names of moving revolute joints that are parallel to a locked joint and have the same parent body.

    frame: pose of the locked joint's parent link in its body. axis: direction (3,) of the locked joint in this body.
    moved: moving joints of the arm. If the parent link belongs to the fixed base, the result is [].
    """
    # Column 2 of `rotation` is the z axis of the joint's frame, which is the axis of the joint, in the parent body.
    beside = [x.body for x in moved if x.body.parent == frame.body >= 0 and x.body.joint_type != "prismatic"]
    return [x.name for x in beside if _are_parallel(axis, np.array(x.rotation, dtype=float)[:, 2])]
