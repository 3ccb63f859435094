"""The description of a trained model that exporters to source code read: plain numbers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.interpolate import BSpline

from spelgen.arm.arm import Arm, Body


@dataclass(frozen=True, eq=False)
class Tip:
    """The frame of a link: ``pose``, (4, 4), in the frame of the body ``carrier``, -1 for the root link.

    bodies: those of the arm, by the angles that the URDF has: the tip is compared with other readers of the file.
    """

    link: str
    carrier: int
    pose: np.ndarray
    bodies: tuple[Body, ...]


@dataclass(frozen=True, eq=False)
class Network:
    """A network of cos q, sin q and q: layers of sigmoids, the last one linear.

    weights: by layer, (units, units below).
    """

    weights: tuple[np.ndarray, ...]
    biases: tuple[np.ndarray, ...]


@dataclass(frozen=True, eq=False)
class Harmonics:
    """A joint's torque [Nm]: cosines @ cos(k frequency q) + sines @ sin(k frequency q), k from 1 on."""

    joint: int
    frequency: float
    cosines: np.ndarray
    sines: np.ndarray


@dataclass(frozen=True, eq=False)
class Residuals:
    """The parts of a model beside its rigid bodies, as far as they are not zero.

    mass: is added to M at these entries of its lower triangle, a row each; potential: to V, one row. torque and ripple:
    dV/dq by joint [Nm, N]. friction: by joint, the logarithm of a factor on its drive's friction. Splines are cubic,
    with zero where they begin and end, and beyond.
    """

    entries: tuple[tuple[int, int], ...]
    mass: Network | None
    potential: Network | None
    torque: dict[int, BSpline]
    ripple: tuple[Harmonics, ...]
    friction: dict[int, BSpline]

    def __bool__(self) -> bool:
        return bool(self.mass or self.potential or self.has_torque or self.friction)

    @property
    def has_torque(self) -> bool:
        """Whether some joint has a torque of its own."""
        return bool(self.torque or self.ripple)


def spline_energy(spline: BSpline) -> BSpline:
    """Return the integral of a torque's spline; as in the runtime, half of its area lies on either side of zero."""
    energy = spline.antiderivative()
    count = len(energy.t) - energy.k - 1
    half = energy(spline.t[-4]) / 2
    return BSpline(energy.t, energy.c[:count] - half, energy.k)


@dataclass(frozen=True, eq=False)
class Servos:
    """``runtime.position_servo``: kp, kd, limit, infinite where nothing limits, dead_zone, (n,); delay [s]."""

    kp: np.ndarray
    kd: np.ndarray
    limit: np.ndarray
    dead_zone: np.ndarray
    delay: float


@dataclass(frozen=True, eq=False)
class TrainedModel:
    """A trained arm of n joints. Units: rad and Nm, or m and N.

    name, identifiers: of robot and joints, for code. inertias: (bodies, 10) about the joints' frames. constant_mass: of
    rotors and other constants in M, (n, n). motors: (n, n), the drives' speeds by the joints', which friction follows.
    friction: the ``FrictionConstants`` of the runtime, as arrays. reach: of the bristles that are its memory, (n, K)
    [rad, m].
    inputs: G, (n, n); actuated: (n,), 0 for a passive joint. friction_compensation: (n,) torque that the drives add by
    velocity, unseen.
    """

    name: str
    arm: Arm
    identifiers: tuple[str, ...]
    inertias: np.ndarray
    constant_mass: np.ndarray
    motors: np.ndarray
    residuals: Residuals
    friction: Any
    reach: np.ndarray
    inputs: np.ndarray
    actuated: np.ndarray
    torque_offset: np.ndarray
    friction_compensation: np.ndarray
    tip: Tip
    servos: Servos | None = None

    @property
    def n(self) -> int:
        """How many joints."""
        return len(self.arm.coordinates)

    @property
    def memory(self) -> int:
        """How many numbers the memory of friction has."""
        return int(self.reach.size)
