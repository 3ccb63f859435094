"""Rows of the tables in an emitted module: joints, links, and functions and constants of the mass matrix."""

import math
from collections.abc import Iterable, Sequence
from typing import Literal, NamedTuple

import torch
from torch import Tensor

Triple = tuple[float, float, float]
Tensor6 = tuple[float, float, float, float, float, float]  # inertia tensor (xx, xy, xz, yy, yz, zz)


def _rounded(value: float) -> float:
    """Return the value rounded to six significant digits."""
    return float(f"{value:.6g}")


class Joint(NamedTuple):
    """A joint of the arm. Units are rad and Nm for a revolute joint, m and N for a prismatic joint."""

    name: str
    joint_type: Literal["revolute", "prismatic"]
    lower: float | None  # position limits [rad, m]; None: unlimited
    upper: float | None
    speed: float  # typical velocity of the joint in motion [rad/s, m/s]
    friction: float  # typical magnitude of the friction torque [Nm, N]
    armature: float  # nominal rotor inertia times gear^2 [kg m^2, kg]
    gear: float = 1.0  # gear ratio: motor revolutions per revolution of the joint
    # (center, half range) of the typical motion [rad, m]. None: computed from the position limits.
    typical_range: tuple[float, float] | None = None

    @property
    def center(self) -> float:
        """Middle of the typical motion if given, else of the position limits; 0 without limits [rad, m]."""
        if self.typical_range is not None:
            return self.typical_range[0]
        return 0.0 if self.lower is None or self.upper is None else _rounded((self.lower + self.upper) / 2)

    @property
    def half_range(self) -> float:
        """Half the range of the typical motion if given, else of the position limits; pi without limits.

        In rad or m. Networks have the position of a prismatic joint as input (q - center) / half_range.
        """
        if self.typical_range is not None:
            return self.typical_range[1]
        return (
            math.pi if self.lower is None or self.upper is None else _rounded((self.upper - self.lower) / 2)
        )


class Link(NamedTuple):
    """A rigid body that a joint moves. Its body frame is the joint frame, whose z axis is the joint axis."""

    name: str
    parent: str | None  # name of the link that carries the joint; None: the base
    joint: str  # name of the joint whose coordinate q displaces the link by ratio * q + offset
    position: Triple  # origin of the joint frame in the frame of the parent, at displacement 0 [m]
    mass: float  # mass of the link [kg]
    center_of_mass: Triple  # center of mass in the joint frame [m]
    inertia: Tensor6  # inertia tensor about the center of mass, in the joint frame [kg m^2]
    rotation: tuple[Triple, Triple, Triple] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    ratio: float = 1.0
    offset: float = 0.0  # displacement about or along the joint axis at q = 0 [rad, m]
    joint_type: Literal["revolute", "prismatic"] | None = None  # None: type of the joint named by `joint`


class Function(NamedTuple):
    """A learned function of joint positions in the mass matrix: mean + scale * output of a network."""

    joints: tuple[str, ...]
    mean: float = 0.0
    scale: float = 1.0


class Constant(NamedTuple):
    """A trained constant in the mass matrix, scale * trained parameter, with its initial value."""

    initial: float
    scale: float


def vector(values: Iterable[float]) -> Tensor:
    """Return the numbers as a float64 tensor, (values,)."""
    return torch.tensor(list(values), dtype=torch.float64)


def joints_of(functions: Sequence[Function]) -> list[tuple[str, ...]]:
    """Return for each function the names of the joints that it depends on."""
    return [function.joints for function in functions]
