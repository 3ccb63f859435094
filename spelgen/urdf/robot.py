"""Data classes for the content of a URDF: robot, links, joints and transmissions."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Literal, NamedTuple

from spelgen.errors import Diagnostic, UrdfError

Vector = tuple[float, float, float]
Tensor = tuple[float, float, float, float, float, float]

JointType = Literal["revolute", "prismatic"]

Assume = Literal["kinematics", "inertials"]
"""Values of the URDF on which the structure depends: the kinematics only, or also the values of the inertials."""

MOVING = ("revolute", "continuous", "prismatic")
"""Types of joints with one degree of freedom."""


class Inertial(NamedTuple):
    """Mass [kg] and inertia tensor of a link.

    ``com`` is the centre of mass [m] and ``rpy`` the orientation of the inertial frame [rad], both in the link frame.
    ``tensor`` is (ixx, ixy, ixz, iyy, iyz, izz) [kg m2] about the centre of mass, in the inertial frame. ``line`` is
    the line of the <inertial> element.
    """

    mass: float
    com: Vector
    rpy: Vector
    tensor: Tensor
    line: int


class UrdfLink(NamedTuple):
    """A link of a URDF; ``inertial`` is None if the link has no usable <inertial>."""

    name: str
    inertial: Inertial | None
    line: int


class Mimic(NamedTuple):
    """The <mimic> of a joint: q = multiplier * q_joint + offset [rad, m]; ``joint`` is the name of the leader."""

    joint: str
    multiplier: float
    offset: float


class UrdfJoint(NamedTuple):
    """A joint of a URDF.

    ``xyz`` [m] and ``rpy`` [rad] are the pose of the joint's frame in the frame of the parent link. ``axis`` is in the
    frame of the joint, as in the file (not normalised); (1, 0, 0) if absent. Limits: ``lower``, ``upper`` [rad, m],
    ``effort`` [Nm, N], ``velocity`` [rad/s, m/s]; None if absent. ``damping`` [Nm s/rad, N s/m], ``friction`` [Nm, N].
    ``soft``: soft lower and upper limit of the <safety_controller> [rad, m]; None if absent.
    """

    name: str
    type: str
    parent: str
    child: str
    xyz: Vector
    rpy: Vector
    axis: Vector
    lower: float | None
    upper: float | None
    effort: float | None
    velocity: float | None
    damping: float
    friction: float
    mimic: Mimic | None
    line: int
    soft: tuple[float, float] | None = None

    @property
    def limits(self) -> tuple[float, float] | None:
        """Position limits in increasing order [rad, m]; None if the lower or the upper limit is absent.

        A lower limit above the upper limit causes a warning of the URDF reader; the two limits are then swapped here.
        """
        if self.lower is None or self.upper is None:
            return None
        return min(self.lower, self.upper), max(self.lower, self.upper)

    @property
    def safe_limits(self) -> tuple[float, float] | None:
        """Position limits in increasing order, narrowed to the soft limits [rad, m]; None if one limit is absent.

        Soft limits outside the position limits are ignored.
        """
        if self.limits is None:
            return None
        low, high = self.limits
        soft_low, soft_high = self.soft or (low, high)
        is_inside = soft_low < high and soft_high > low
        return (max(low, soft_low), min(high, soft_high)) if is_inside else (low, high)

    @property
    def moves(self) -> bool:
        """Whether the joint is revolute, continuous or prismatic; mimic joints are included."""
        return self.type in MOVING


class Transmission(NamedTuple):
    """A transmission: actuators that drive joints.

    ``joints`` are pairs (name, reduction), ``actuators`` reductions; an absent number is None. ``errors`` are the
    defects of the numbers; a step that needs the transmission raises them.
    """

    type: str
    joints: tuple[tuple[str, float | None], ...]
    actuators: tuple[float | None, ...]
    errors: tuple[UrdfError, ...] = ()

    @property
    def joint_names(self) -> list[str]:
        """Names of the joints that the transmission drives."""
        return [name for name, _ in self.joints]


@dataclass(frozen=True)
class Robot:
    """The content of a URDF: a tree of links and joints, in the order of the file.

    ``source`` is the file that errors name. ``root`` is the name of the root link. ``digest`` is the SHA-256 of the
    file in hexadecimal; for a xacro file, of the expanded document. Line numbers of links and joints refer to the
    same document.
    """

    name: str
    path: Path
    source: Path
    digest: str
    links: tuple[UrdfLink, ...]
    joints: tuple[UrdfJoint, ...]
    transmissions: tuple[Transmission, ...]
    root: str
    diagnostics: tuple[Diagnostic, ...]

    @cached_property
    def link(self) -> dict[str, UrdfLink]:
        """{name: link} of all links."""
        return {link.name: link for link in self.links}

    @cached_property
    def joint(self) -> dict[str, UrdfJoint]:
        """{name: joint} of all joints."""
        return {joint.name: joint for joint in self.joints}

    @cached_property
    def joint_above(self) -> dict[str, UrdfJoint]:
        """{name of a link: the joint whose child it is}, for all links except the root."""
        return {joint.child: joint for joint in self.joints}

    @cached_property
    def joints_below(self) -> dict[str, tuple[UrdfJoint, ...]]:
        """{name of a link: the joints whose parent it is}, for all links."""
        # Links without child joints have an empty entry, so that no caller needs a default.
        below: dict[str, tuple[UrdfJoint, ...]] = {link.name: () for link in self.links}
        for joint in self.joints:
            below[joint.parent] += (joint,)
        return below

    @cached_property
    def joints_from_root(self) -> tuple[UrdfJoint, ...]:
        """All joints, parents before their children, depth first in the order of the file."""
        ordered: list[UrdfJoint] = []
        # Joints are visited with a stack and not by recursion, because the depth of the tree may exceed the recursion
        # limit of Python.
        pending = list(reversed(self.joints_below[self.root]))
        while pending:
            joint = pending.pop()
            ordered.append(joint)
            pending.extend(reversed(self.joints_below[joint.child]))
        return tuple(ordered)

    def path_to(self, link: str) -> tuple[UrdfJoint, ...]:
        """Return the joints on the path from the root to the link named ``link``, root first."""
        path: list[UrdfJoint] = []
        while link in self.joint_above:
            path.append(self.joint_above[link])
            link = path[-1].parent
        return tuple(reversed(path))

    def last_link(self, joints: Sequence[str]) -> str:
        """Return the last link behind the given joints, for example a flange.

        The search starts at the child link of the last joint. It follows fixed joints from parent to child, and ends at
        a link with no fixed joint, or with several.
        """
        link = self.joint[joints[-1]].child
        while True:
            fixed = [joint.child for joint in self.joints_below[link] if joint.type == "fixed"]
            if len(fixed) != 1:
                return link
            link = fixed[0]
