"""The description of a trained model that exporters to source code read: plain numbers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import BSpline

from spelgen.arm.arm import Arm


@dataclass(frozen=True, eq=False)
class TipJoint:
    """A joint on the way to the tip: origin (4, 4), then a turn about z or a slide along it by row @ q + offset."""

    name: str
    origin: np.ndarray
    revolute: bool
    row: np.ndarray
    offset: float


@dataclass(frozen=True, eq=False)
class FrictionLaw:
    """Hold the constants of ``runtime.friction_laws``, (n,) each, in their units."""

    viscous: np.ndarray
    saturation: np.ndarray
    saturation_velocity: np.ndarray
    coulomb: np.ndarray
    stribeck: np.ndarray
    stribeck_velocity: np.ndarray
    stribeck_rounding: np.ndarray
    coulomb_smoothing_velocity: np.ndarray
    load_dependence: np.ndarray
    least_load: np.ndarray
    memoryless: np.ndarray


@dataclass(frozen=True, eq=False)
class Bristles:
    """The memory of friction: ``count`` elements a joint, (n, count).

    reach: [rad, m]. fractions: of dry friction.
    """

    reach: np.ndarray
    fractions: np.ndarray

    @property
    def count(self) -> int:
        """How many elements a joint has."""
        return int(self.reach.shape[1])


@dataclass(frozen=True, eq=False)
class Network:
    """A network of cos q, sin q and, where some joint is prismatic, q: layers of sigmoids, the last one linear.

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

    name: for code. inertias: (bodies, 10) about the joints' frames. constant_mass: of rotors and other constants in
    M, (n, n). motors: (n, n), the drives' speeds by the joints', which friction follows. inputs: G, (n, n);
    actuated: (n,), 0 for a passive joint. friction_compensation: (n,) torque that the drives add by velocity, unseen.
    entries: names of the functions that are written; none for all.
    """

    name: str
    arm: Arm
    preset: str
    identifiers: tuple[str, ...]
    inertias: np.ndarray
    constant_mass: np.ndarray
    motors: np.ndarray
    residuals: Residuals
    friction: FrictionLaw
    bristles: Bristles | None
    inputs: np.ndarray
    actuated: np.ndarray
    torque_offset: np.ndarray
    friction_compensation: np.ndarray
    tip: tuple[TipJoint, ...]
    tip_end: np.ndarray
    servos: Servos | None = None
    entries: tuple[str, ...] = ()

    @property
    def n(self) -> int:
        """How many joints."""
        return len(self.arm.coordinates)

    @property
    def memory(self) -> int:
        """How many numbers the memory of friction has."""
        if self.bristles is None:
            return 0
        return self.n * self.bristles.count
