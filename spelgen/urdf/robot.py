"""A robot as its URDF says it: links, joints and transmissions, nothing computed."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Literal

from spelgen.errors import Diagnostic, UrdfError

Vector = tuple[float, float, float]
Tensor = tuple[float, float, float, float, float, float]

Assume = Literal["kinematics", "inertials"]
"""Values of the URDF that are trusted: the kinematics, or also the inertials' zeros and symmetries."""

MOVING = ("revolute", "continuous", "prismatic")
"""Joint types with one degree of freedom."""


@dataclass(frozen=True)
class Inertial:
    """Mass [kg], centre of mass and orientation of the inertial frame in the link frame [m, rad].

    ``tensor`` is (ixx, ixy, ixz, iyy, iyz, izz) [kg m2] about the centre of mass, in the inertial frame.
    """

    mass: float
    com: Vector
    rpy: Vector
    tensor: Tensor
    line: int


@dataclass(frozen=True)
class Link:
    """A rigid body; ``inertial`` is None where the file gives none."""

    name: str
    inertial: Inertial | None
    line: int


@dataclass(frozen=True)
class Mimic:
    """A joint that follows another: q = multiplier * q_joint + offset [rad or m]."""

    joint: str
    multiplier: float
    offset: float


@dataclass(frozen=True)
class Joint:
    """A joint; ``xyz`` [m] and ``rpy`` [rad] place it in the parent link's frame, ``axis`` is in its own.

    Limits are in rad or m, N m or N, and per second, None where absent; ``axis`` is as written, (1, 0, 0)
    where absent.
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


@dataclass(frozen=True)
class Transmission:
    """Which actuators (name, reduction) drive which joints (name, reduction, offset); None where absent.

    ``errors``: what cannot be read of it, for the step that needs it: most need none of the transmissions.
    """

    name: str
    type: str
    joints: tuple[tuple[str, float | None, float | None], ...]
    actuators: tuple[tuple[str, float | None], ...]
    line: int
    errors: tuple[UrdfError, ...] = ()

    @property
    def joint_names(self) -> list[str]:
        """Names of the joints that it drives."""
        return [name for name, _, _ in self.joints]


@dataclass(frozen=True)
class Robot:
    """A tree of links and joints in file order; ``digest`` is the SHA-256 of its bytes in hexadecimal.

    ``told_as`` is how errors name the file: a xacro file's lines and digest are those of its expansion.
    """

    name: str
    path: Path
    told_as: Path
    digest: str
    links: tuple[Link, ...]
    joints: tuple[Joint, ...]
    transmissions: tuple[Transmission, ...]
    root: str
    diagnostics: tuple[Diagnostic, ...]

    @cached_property
    def link(self) -> dict[str, Link]:
        """The links by name."""
        return {link.name: link for link in self.links}

    @cached_property
    def joint(self) -> dict[str, Joint]:
        """The joints by name."""
        return {joint.name: joint for joint in self.joints}

    @cached_property
    def joint_above(self) -> dict[str, Joint]:
        """The joint that carries a link, by the link's name; the root has none."""
        return {joint.child: joint for joint in self.joints}

    @cached_property
    def joints_below(self) -> dict[str, tuple[Joint, ...]]:
        """The joints that leave a link, by the link's name, in file order."""
        below: dict[str, list[Joint]] = {link.name: [] for link in self.links}
        for joint in self.joints:
            below[joint.parent].append(joint)
        return {name: tuple(joints) for name, joints in below.items()}

    @cached_property
    def joints_from_root(self) -> tuple[Joint, ...]:
        """All joints, parents before their children, depth first in file order."""
        ordered: list[Joint] = []
        # a stack, since a hostile file may be nested deeper than Python recurses
        pending = list(reversed(self.joints_below[self.root]))
        while pending:
            joint = pending.pop()
            ordered.append(joint)
            pending.extend(reversed(self.joints_below[joint.child]))
        return tuple(ordered)

    def path_to(self, link: str) -> tuple[Joint, ...]:
        """The joints from the root to ``link``, in that order."""
        # from the link upwards: each link has one joint above it, but many below
        path: list[Joint] = []
        while link in self.joint_above:
            path.append(self.joint_above[link])
            link = path[-1].parent
        return tuple(reversed(path))
