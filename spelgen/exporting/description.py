"""A trained model for exporters of source code, as plain numbers, and the functions of an export by entry points."""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.interpolate import BSpline

from spelgen.arm.arm import Chain
from spelgen.dynamics.tip_frame import Tip
from spelgen.errors import RunError


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

    @property
    def input_inverse(self) -> np.ndarray:
        """Inputs per generalised force, (n, n); at a passive joint, the torque required there."""
        return np.linalg.inv(self.inputs + np.diag(1 - self.actuated))


@dataclass(frozen=True)
class EntryPoint:
    """A function of an export.

    inputs: names among q, qd, qdd, tau, u, dq (n numbers each) and z (the friction state). outputs: units by name.
    """

    name: str
    about: str
    inputs: tuple[str, ...]
    outputs: dict[str, str]


def read_entries(text: str) -> dict[str, EntryPoint]:
    """Return entry points by name: of each, a line ``name(inputs) -> output [unit], ...``, then its description."""
    entries = {}
    lines = text.strip().splitlines()
    for signature, about in zip(lines[::2], lines[1::2], strict=True):
        start, outputs = signature.split(") -> ")
        name, inputs = start.split("(")
        units = dict(re.findall(r"(\w+) \[(.*?)\]", outputs))
        entries[name] = EntryPoint(name, about.strip(), tuple(inputs.split(", ")), units)
    return entries


ENTRY_POINTS = read_entries("""
inverse_dynamics(q, qd, qdd, z) -> tau [Nm, N]
    the torques that give qdd, friction included
forward_dynamics(q, qd, tau, z) -> qdd [rad/s^2, m/s^2]
    the accelerations under the torques tau
mass_matrix(q) -> mass [kg m^2, kg m, kg]
    M, armature included
bias(q, qd) -> bias [Nm, N]
    Coriolis, centrifugal and gravity torques
gravity(q) -> gravity [Nm, N]
    the torques that hold the arm still, dV/dq
friction(q, qd, z) -> friction [Nm, N]
    the torques of friction
friction_step(z, dq) -> z_next [rad, m]
    the friction state after a displacement dq of each joint
friction_memory(qd) -> z_start [rad, m]
    the initial friction state of joints that have moved at constant qd
momentum(q, qd) -> momentum [Nm s, N s]
    M qd
energy(q, qd) -> energy [J]
    kinetic energy, then potential
tip_pose(q) -> pose [1, m]
    the tip's homogeneous transform in the root link's frame
tip_jacobian(q) -> jacobian [m, 1]
    the tip's linear, then angular velocity by qd, in the root link's axes
inverse_dynamics_derivatives(q, qd, qdd, z) -> dtau_dq [Nm/rad], dtau_dqd [Nm s/rad]
    the derivatives of inverse_dynamics; its derivative by qdd is the mass matrix
forward_dynamics_derivatives(q, qd, tau, z) -> dqdd_dq [1/s^2], dqdd_dqd [1/s], dqdd_dtau [1/(kg m^2)]
    the derivatives of forward_dynamics
servo_torque(u, q, qd) -> tau [Nm, N]
    the torques of position servos under a command u, which the caller delays
""")
"""All functions by name."""


def entry_points(model: TrainedModel, names: Sequence[str] = ()) -> dict[str, EntryPoint]:
    """Return entry points of a model by name; no names: all except derivatives. Raises RunError for unknown names."""
    available = list(ENTRY_POINTS)
    if model.servos is None:
        available.remove("servo_torque")
    if not names:
        # derivatives are two thirds of the code, and rarely needed
        names = [name for name in available if not name.endswith("_derivatives")]
    return {name: ENTRY_POINTS[name] for name in select_names(names, available)}


def select_names(names: Sequence[str], available: Iterable[str]) -> list[str]:
    """Return the names in the order of those available; no names: all. Raises RunError for unknown names."""
    options = list(available)
    for name in names:
        if name not in options:
            expected = f"one of {', '.join(options)}"
            raise RunError(f"the function {name!r}", expected=expected)
    # in a fixed order: the same names give the same files
    return [name for name in options if name in names or not names]
