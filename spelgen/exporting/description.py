"""Description of a trained model for exporters of source code: plain numbers and arrays."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.interpolate import BSpline

from spelgen.arm.arm import Chain
from spelgen.dynamics.tip_frame import Tip


@dataclass(frozen=True, eq=False)
class SigmoidNetwork:
    """A network with the inputs cos q, sin q and q: layers of sigmoids, then a linear layer.

    weights: of each layer, (units, units of the layer before). biases: (units,).
    """

    weights: tuple[np.ndarray, ...]
    biases: tuple[np.ndarray, ...]


@dataclass(frozen=True, eq=False)
class Harmonics:
    """Torque ripple of a joint [Nm]: sum over k = 1, 2, ... of cosines[k] cos(k frequency q) + sines[k] sin(...)."""

    joint: int
    frequency: float
    cosines: np.ndarray
    sines: np.ndarray


@dataclass(frozen=True, eq=False)
class Residuals:
    """The residual terms of a model that are not zero.

    entries: row and column of the entries of M's lower triangle that ``mass`` is added to, one per output. potential:
    is added to V, one output. torque, ripple: contributions to dV/dq [Nm, N] per joint. friction: logarithm of a factor
    on the friction of a drive, per joint. Splines are cubic, and zero outside of their knots.
    """

    entries: tuple[tuple[int, int], ...]
    mass: SigmoidNetwork | None
    potential: SigmoidNetwork | None
    torque: dict[int, BSpline]
    ripple: tuple[Harmonics, ...]
    friction: dict[int, BSpline]

    def __bool__(self) -> bool:
        return bool(self.mass or self.potential or self.has_torque or self.friction)

    @property
    def has_torque(self) -> bool:
        """Whether any joint has a torque spline or ripple."""
        return bool(self.torque or self.ripple)


def spline_energy(spline: BSpline) -> BSpline:
    """Return the integral of a torque spline; as in the runtime, its values at both ends have the same magnitude."""
    energy = spline.antiderivative()
    count = len(energy.t) - energy.k - 1
    half = energy(spline.t[-4]) / 2
    return BSpline(energy.t, energy.c[:count] - half, energy.k)


@dataclass(frozen=True, eq=False)
class Servos:
    """Constants of ``runtime.position_servo``, (n,), and the delay [s]. limit: infinite without an effort limit."""

    kp: np.ndarray
    kd: np.ndarray
    limit: np.ndarray
    dead_zone: np.ndarray
    delay: float


@dataclass(frozen=True, eq=False)
class TrainedModel:
    """A trained model of an arm with n joints, in rad and Nm, or m and N.

    name, identifiers: of the robot and of the joints, for code. inertias: (bodies, 10) inertial parameters in the
    frames of the joints. constant_mass: (n, n) part of M that does not depend on q, armature included. motors: C, (n,
    n), motor velocities per joint velocities. friction: the ``FrictionConstants`` of the runtime, as arrays. breakaway:
    (n, K) break-away displacements of the bristles [rad, m]. inputs: G, (n, n). actuated: (n,), 0 for a passive joint.
    torque_offset: (n,). friction_compensation: (n,) torque per velocity that the drives add and do not measure.
    """

    name: str
    arm: Chain
    identifiers: tuple[str, ...]
    inertias: np.ndarray
    constant_mass: np.ndarray
    motors: np.ndarray
    residuals: Residuals
    friction: Any
    breakaway: np.ndarray
    inputs: np.ndarray
    actuated: np.ndarray
    torque_offset: np.ndarray
    friction_compensation: np.ndarray
    tip: Tip
    servos: Servos | None = None

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.arm.coordinates)

    @property
    def memory(self) -> int:
        """Number of bristles, the size of the friction state z."""
        return int(self.breakaway.size)
