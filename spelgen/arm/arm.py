"""Robot -> Chain: the serial chain with exact geometry; links on fixed and locked joints are lumped."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from math import pi

from spelgen.arm.chain import ChainChoice, choose_chain, leaders
from spelgen.arm.lump_links import MovingJoint, lump_links
from spelgen.arm.placement import TenVector
from spelgen.arm.rational import Matrix, Vector, as_matrix, as_vector, exact
from spelgen.errors import ArmError, Diagnostic
from spelgen.urdf.robot import JointType, Robot, UrdfJoint

# Largest number of joints: the cost of the derivation increases with about the fifth power.
MAX_JOINTS = 16
# Largest number of mimic joints, each of which is a separate body in the derivation.
MAX_FOLLOWERS = 48


@dataclass(frozen=True)
class Coordinate:
    """A degree of freedom; limits as in the file (rad or m, N m or N, per second), None if absent."""

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
        """Lower and upper limit [rad, m]; None for a continuous joint, and if one is absent."""
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

    ``gravity`` [m/s2] is in the frame of the root link; ``locked`` are the names of locked joints; ``diagnostics`` are
    the diagnostics of this step, without the diagnostics of the robot.
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
    def joint_types(self) -> tuple[JointType, ...]:
        """Types of the coordinates."""
        return tuple(coordinate.joint_type for coordinate in self.coordinates)

    @property
    def inertials_complete(self) -> bool:
        """Whether every body has an inertial with mass."""
        return all(body.inertia is not None and body.inertia[0] > 0 for body in self.bodies)


def make_arm(
    robot: Robot,
    *,
    joints: Sequence[str] | None = None,
    tip: str | None = None,
    angle_tolerance: float = 2e-3,
    gravity: Sequence[float] = (0.0, 0.0, -9.81),
) -> Chain:
    """Return an arm of a robot; all joints that are not part of the arm are locked at 0.

    Args:
        robot: the robot.
        joints: names of the moving joints.
        tip: the last link, in place of ``joints``; without both, the arm is the longest serial chain.
        angle_tolerance: angles within it [rad] of a multiple of pi/2 are rounded to it; 0: none are.
        gravity: acceleration of gravity in the frame of the root link [m/s2].

    Raises ArmError.
    """
    if not 0 <= angle_tolerance < pi / 4:
        got = f"an angle tolerance of {angle_tolerance:g} rad"
        raise ArmError(got, expected="at least 0 and less than pi/4 (0.785)")
    chain = choose_chain(robot, joints, tip)
    _require_small(robot, chain)
    lumped = lump_links(robot, chain, angle_tolerance)
    locked = {joint.name for joint in lumped.locked if joint.type != "fixed"}
    bodies = []
    for moved in lumped.moved:
        bodies.append(_body(moved, chain.names.index(moved.followed.leader.name)))
    # exact, so that the gravity torque of a vertical axis is 0 and not 1e-17
    x, y, z = map(exact, map(float, gravity))
    return Chain(
        name=robot.name,
        coordinates=tuple(map(_coordinate, chain.joints)),
        bodies=tuple(bodies),
        gravity=(x, y, z),
        diagnostics=lumped.diagnostics,
        locked=tuple(joint.name for joint in robot.joints if joint.name in locked),
    )


def _require_small(robot: Robot, chain: ChainChoice) -> None:
    """Raise ArmError for an arm whose derivation would take more than some seconds."""
    moving = len(chain.joints)
    if moving > MAX_JOINTS:
        do = "choose fewer with --joints or --tip"
        raise ArmError(f"{moving} joints", file=robot.source, expected=f"at most {MAX_JOINTS}", do=do)
    following = -moving  # each joint of the chain is its own leader
    for follow in leaders(robot).values():
        following += follow.leader.name in chain.names
    if following > MAX_FOLLOWERS:
        got = f"{following} joints that follow others by <mimic>"
        raise ArmError(got, file=robot.source, expected=f"at most {MAX_FOLLOWERS}", do="fix some of them")


def _body(moved: MovingJoint, coordinate: int) -> Body:
    return Body(
        name=moved.joint.name,
        link=moved.joint.child,
        joint_type=_joint_type(moved.joint),
        parent=moved.pose.parent,
        coordinate=coordinate,
        multiplier=moved.followed.multiplier,
        offset=float(moved.followed.offset),
        rotation=as_matrix(moved.pose.rotation),
        translation=as_vector(moved.pose.translation),
        inertia=moved.inertia,
    )


def _coordinate(joint: UrdfJoint) -> Coordinate:
    return Coordinate(
        name=joint.name,
        joint_type=_joint_type(joint),
        continuous=joint.type == "continuous",
        lower=joint.lower,
        upper=joint.upper,
        effort=joint.effort,
        velocity=joint.velocity,
        damping=joint.damping,
        friction=joint.friction,
        passive=False,
    )


def _joint_type(joint: UrdfJoint) -> JointType:
    if joint.type == "prismatic":
        return "prismatic"
    return "revolute"
