"""A robot with the values of its URDF: links, joints and transmissions."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Literal, NamedTuple

from spelgen.errors import Diagnostic, UrdfError

Vector = tuple[float, float, float]
Tensor = tuple[float, float, float, float, float, float]

JointType = Literal["revolute", "prismatic"]

Assume = Literal["kinematics", "inertials"]
"""Values of the URDF that determine the structure: the kinematics, or also zeros and symmetries of inertials."""

MOVING = ("revolute", "continuous", "prismatic")
"""Types of joints with one degree of freedom."""


class Inertial(NamedTuple):
    """Mass [kg], centre of mass and orientation of the inertial frame in the link frame [m, rad].

    ``tensor`` is (ixx, ixy, ixz, iyy, iyz, izz) [kg m2] about the centre of mass, in the inertial frame.
    """

    mass: float
    com: Vector
    rpy: Vector
    tensor: Tensor
    line: int


class UrdfLink(NamedTuple):
    """A link; ``inertial`` is None if absent."""

    name: str
    inertial: Inertial | None
    line: int


class Mimic(NamedTuple):
    """A joint that follows another: q = multiplier * q_joint + offset [rad or m]."""

    joint: str
    multiplier: float
    offset: float


class UrdfJoint(NamedTuple):
    """A joint at ``xyz`` [m] and ``rpy`` [rad] in the frame of the parent link; ``axis`` is in the frame of the joint.

    Limits are in rad or m, N m or N, and per second, None if absent. ``axis`` is not normalised; (1, 0, 0) if absent.
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

    @property
    def moves(self) -> bool:
        """Whether the joint has one degree of freedom, its own or its leader's."""
        return self.type in MOVING


class Transmission(NamedTuple):
    """Actuators (name, reduction) that drive joints (name, reduction, offset); None for an absent number.

    ``errors`` are raised by a step that needs the transmission.
    """

    name: str
    type: str
    joints: tuple[tuple[str, float | None, float | None], ...]
    actuators: tuple[tuple[str, float | None], ...]
    line: int
    errors: tuple[UrdfError, ...] = ()

    @property
    def joint_names(self) -> list[str]:
        """Names of the driven joints."""
        return [name for name, _, _ in self.joints]


@dataclass(frozen=True)
class Robot:
    """A tree of links and joints in the order of the file; ``digest`` is the SHA-256 of its bytes in hexadecimal.

    ``source`` is the name of the file in errors; for a xacro file, lines and digest refer to the expanded document.
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
        """The links by name."""
        return {link.name: link for link in self.links}

    @cached_property
    def joint(self) -> dict[str, UrdfJoint]:
        """The joints by name."""
        return {joint.name: joint for joint in self.joints}

    @cached_property
    def joint_above(self) -> dict[str, UrdfJoint]:
        """The joint whose child is a link, by the name of the link; the root link has none."""
        return {joint.child: joint for joint in self.joints}

    @cached_property
    def joints_below(self) -> dict[str, tuple[UrdfJoint, ...]]:
        """The joints whose parent is a link, by the name of the link, in the order of the file."""
        # All links have an entry, so that the tips are the links with an empty one.
        below: dict[str, tuple[UrdfJoint, ...]] = {link.name: () for link in self.links}
        for joint in self.joints:
            below[joint.parent] += (joint,)
        return below

    @cached_property
    def joints_from_root(self) -> tuple[UrdfJoint, ...]:
        """All joints, parents before their children, depth first in the order of the file."""
        ordered: list[UrdfJoint] = []
        # A stack replaces recursion: the nesting in a file is not bounded.
        pending = list(reversed(self.joints_below[self.root]))
        while pending:
            joint = pending.pop()
            ordered.append(joint)
            pending.extend(reversed(self.joints_below[joint.child]))
        return tuple(ordered)

    def path_to(self, link: str) -> tuple[UrdfJoint, ...]:
        """Return the joints from the root to ``link``, in this order."""
        path: list[UrdfJoint] = []
        while link in self.joint_above:
            path.append(self.joint_above[link])
            link = path[-1].parent
        return tuple(reversed(path))
