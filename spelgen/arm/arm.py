"""Robot -> Arm: the serial chain, fixed and locked links lumped, mimic joints folded in, geometry exact."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from math import pi
from typing import Literal

from spelgen.arm.chain import Chain, choose_chain, follows
from spelgen.arm.lump_links import Moved, lump_links
from spelgen.arm.placement import TenVector
from spelgen.arm.rational import Matrix, Vector, as_matrix, as_vector, exact
from spelgen.errors import ArmError, Diagnostic
from spelgen.urdf.robot import Joint, Robot

Kind = Literal["revolute", "prismatic"]

MOST_JOINTS = 16
"""Longest arm that is taken: what comes after grows with about the fifth power of it."""

MOST_FOLLOWERS = 48
"""Most joints that follow others by <mimic>: each is a body of its own in all that comes after."""


@dataclass(frozen=True)
class Coordinate:
    """Hold one degree of freedom; limits as in the file (rad or m, N m or N, per second), None where absent."""

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

    @property
    def limits(self) -> tuple[float, float] | None:
        """Return lower and upper limit of a joint that has both and cannot turn on and on."""
        if self.continuous or self.lower is None or self.upper is None:
            return None
        return self.lower, self.upper


@dataclass(frozen=True)
class Body:
    """A joint and all links that move rigidly with it.

    ``link`` is the name of the child link of the joint. ``rotation`` and ``translation`` [m] are the pose of the
    joint's frame in the frame of the parent body (parent -1: the root link) at zero position; the joint rotates about,
    or translates along, z of its frame by multiplier * q + offset, q the coordinate. ``inertia`` is (m, m c, Ixx, Ixy,
    Ixz, Iyy, Iyz, Izz) [kg, kg m, kg m^2] about the origin of the joint's frame, in that frame; None if no link of the
    body has an inertial.
    """

    name: str
    link: str
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
    """Hold a serial arm with n coordinates, root first; ``bodies`` hold the chain in its order, parents first.

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
    def joint_names(self) -> tuple[str, ...]:
        """Names of the coordinates, as in the URDF."""
        return tuple(coordinate.name for coordinate in self.coordinates)

    @property
    def joint_types(self) -> tuple[Kind, ...]:
        """Whether each coordinate turns or slides."""
        return tuple(coordinate.kind for coordinate in self.coordinates)

    @property
    def has_inertials(self) -> bool:
        """Whether every body has an inertial with mass."""
        return all(body.inertia is not None and body.inertia[0] > 0 for body in self.bodies)


def make_arm(
    robot: Robot,
    *,
    joints: Sequence[str] | None = None,
    tip: str | None = None,
    angle_tolerance: float = 2e-3,
    gravity: Sequence[float] = (0.0, 0.0, -9.81),
) -> Arm:
    """Return the arm of the named ``joints``, up to the link ``tip``, or of the longest serial chain.

    All other joints are locked at 0.

    ``angle_tolerance`` [rad] is how far an angle may be from a multiple of pi/2 to be taken as one; 0 takes
    the file as it stands. Raises ``ArmError``.
    """
    if not 0 <= angle_tolerance < pi / 4:
        got = f"an angle tolerance of {angle_tolerance:g} rad"
        raise ArmError(got, expected="at least 0 and less than pi/4 (0.785)")
    # the choice may raise: nothing is placed or made exact before
    chain = choose_chain(robot, joints, tip)
    _require_small(robot, chain)
    lumped = lump_links(robot, chain, angle_tolerance)
    locked = {joint.name for joint in lumped.held if joint.type != "fixed"}
    bodies = []
    # all bodies of one coordinate move with it, so bodies are found by their leader
    for moved in lumped.moved:
        bodies.append(_body(moved, chain.names.index(moved.followed.leader.name)))
    # exact, so that a horizontal joint has no gravity torque at all and not one of 1e-17
    x, y, z = map(exact, map(float, gravity))
    return Arm(
        name=robot.name,
        coordinates=tuple(map(_coordinate, chain.joints)),
        bodies=tuple(bodies),
        gravity=(x, y, z),
        diagnostics=lumped.diagnostics,
        locked=tuple(joint.name for joint in robot.joints if joint.name in locked),
    )


def _require_small(robot: Robot, chain: Chain) -> None:
    """Refuse what would take more than seconds, before any of it is done."""
    # M of 16 joints has 136 entries, each over ten parameters of 16 bodies
    moving = len(chain.joints)
    if moving > MOST_JOINTS:
        do = "choose fewer with --joints or --tip"
        raise ArmError(f"{moving} joints", file=robot.told_as, expected=f"at most {MOST_JOINTS}", do=do)
    following = -moving  # each joint of the chain follows itself
    for follow in follows(robot).values():
        following += follow.leader.name in chain.names
    if following > MOST_FOLLOWERS:
        got = f"{following} joints that follow others by <mimic>"
        raise ArmError(got, file=robot.told_as, expected=f"at most {MOST_FOLLOWERS}", do="fix some of them")


def _body(moved: Moved, coordinate: int) -> Body:
    return Body(
        name=moved.joint.name,
        link=moved.joint.child,
        kind=_kind(moved.joint),
        parent=moved.pose.parent,
        coordinate=coordinate,
        multiplier=moved.followed.multiplier,
        offset=float(moved.followed.offset),
        rotation=as_matrix(moved.pose.rotation),
        translation=as_vector(moved.pose.translation),
        inertia=moved.inertia,
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
    if joint.type == "prismatic":
        return "prismatic"
    return "revolute"
