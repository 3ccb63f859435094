"""The rows of an emitted module: joints, links, and the functions and constants of the mass matrix."""

import math
from collections.abc import Iterable, Sequence
from typing import Literal, NamedTuple

import torch
from torch import Tensor

Triple = tuple[float, float, float]
Tensor6 = tuple[float, float, float, float, float, float]  # (xx, xy, xz, yy, yz, zz)


def _rounded(value: float) -> float:
    """Return a value to six significant digits."""
    return float(f"{value:.6g}")


class Joint(NamedTuple):
    """A joint. Positions are in rad and torques in Nm if it is revolute, in m and N if it is prismatic."""

    name: str
    joint_type: Literal["revolute", "prismatic"]
    lower: float | None  # limits of the position; None: unlimited
    upper: float | None
    speed: float  # typical velocity [rad/s, m/s]
    friction: float  # typical friction torque [Nm, N]
    armature: float  # nominal rotor inertia times gear ratio squared [kg m^2, kg]
    gear: float = 1.0  # motor revolutions per revolution of the joint
    typical_range: tuple[float, float] | None = None  # center and half range; None: from the limits

    @property
    def center(self) -> float:
        """Middle of the range of motion."""
        if self.typical_range is not None:
            return self.typical_range[0]
        return 0.0 if self.lower is None or self.upper is None else _rounded((self.lower + self.upper) / 2)

    @property
    def half_range(self) -> float:
        """Half the range of motion: networks depend on (q - center) / half_range of a prismatic joint."""
        if self.typical_range is not None:
            return self.typical_range[1]
        return (
            math.pi if self.lower is None or self.upper is None else _rounded((self.upper - self.lower) / 2)
        )


class Link(NamedTuple):
    """A rigid body that a joint moves, in the frame of that joint: z is its axis."""

    name: str
    parent: str | None  # the link that carries it; None: the base
    joint: str  # moves it by ratio * q + offset
    position: Triple  # origin of the joint's frame in the parent's frame at q = 0 [m]
    mass: float  # [kg]
    center_of_mass: Triple  # [m]
    inertia: Tensor6  # about the center of mass [kg m^2]
    rotation: tuple[Triple, Triple, Triple] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    ratio: float = 1.0
    offset: float = 0.0  # [rad, m]
    joint_type: Literal["revolute", "prismatic"] | None = None  # None: as the joint


class Function(NamedTuple):
    """A learned function of the positions of some joints: mean + scale * network."""

    joints: tuple[str, ...]
    mean: float = 0.0
    scale: float = 1.0


class Constant(NamedTuple):
    """A trained constant and its initial value, in units of ``scale``."""

    initial: float
    scale: float


def vector(values: Iterable[float]) -> Tensor:
    """Return the values as a float64 tensor, (values,)."""
    return torch.tensor(list(values), dtype=torch.float64)


def joints_of(functions: Sequence[Function]) -> list[tuple[str, ...]]:
    """Return the names of the joints that each function depends on."""
    return [function.joints for function in functions]
