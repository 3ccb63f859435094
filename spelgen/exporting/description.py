"""``TrainedModel``, a trained model as NumPy arrays; and the entry points, the functions that an export contains."""

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
    """A network with inputs cos q, sin q and q of all joints: layers of sigmoids, then a linear layer.

    weights: weights per layer, (units, units of the previous layer). biases: biases per layer, (units,).
    """

    weights: tuple[np.ndarray, ...]
    biases: tuple[np.ndarray, ...]


@dataclass(frozen=True, eq=False)
class Harmonics:
    """Torque ripple of a joint [Nm]: a sum over k = 1, 2, ... at the position q of the joint.

    The terms are cosines[k - 1] cos(k frequency q) + sines[k - 1] sin(k frequency q).
    """

    joint: int
    frequency: float
    cosines: np.ndarray
    sines: np.ndarray


@dataclass(frozen=True, eq=False)
class Residuals:
    """The residual terms of a model that are not zero.

    mass: network whose outputs are added to entries of M's lower triangle. entries: row and column of the entry, per
    output. potential: network whose output is added to V. torque, ripple: contributions to dV/dq [Nm, N] per joint.
    friction: logarithm of the factor on a drive's friction, per joint. Splines are cubic, and zero outside of their
    knots.
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
    """Return the potential energy of a torque spline, its antiderivative.

    The energies at both ends of the range have equal magnitudes and opposite signs, as in the runtime.
    """
    energy = spline.antiderivative()
    count = len(energy.t) - energy.k - 1
    half = energy(spline.t[-4]) / 2
    return BSpline(energy.t, energy.c[:count] - half, energy.k)


@dataclass(frozen=True, eq=False)
class Servos:
    """Constants of position servos, (n,) each, as in ``runtime.PositionServo``, and the delay of the command [s].

    limit: largest torque [Nm, N]; infinite for a servo without a limit.
    """

    kp: np.ndarray
    kd: np.ndarray
    limit: np.ndarray
    dead_zone: np.ndarray
    delay: float


@dataclass(frozen=True, eq=False)
class TrainedModel:
    """A trained model of an arm with n joints: rad and Nm for revolute joints, m and N for prismatic joints.

    name: identifier of the robot in code. joint_labels: names of the joints in comments, of letters, digits and _.
    inertias: inertial parameters in the frames of the joints, (bodies, 10). constant_mass: armature and constant
    residual terms of M, (n, n). motors: C, (n, n), motor velocities per joint velocities. friction: the
    ``FrictionConstants`` of the runtime, as arrays. breakaway: break-away displacements of the bristles, (n, K) [rad,
    m]. inputs: G, (n, n), joint torque per motor torque. actuated: 0 for a passive joint, otherwise 1, (n,).
    torque_offset: measured torque at zero torque, (n,). friction_compensation: torque per velocity that the drives
    add but do not report, (n,).
    """

    name: str
    arm: Chain
    joint_labels: tuple[str, ...]
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
        """G^-1, (n, n): motor torque per joint torque; at a passive joint, the joint torque itself."""
        return np.linalg.inv(self.inputs + np.diag(1 - self.actuated))


@dataclass(frozen=True)
class EntryPoint:
    """A function that exports contain, and the names of its arguments and results.

    inputs: names of arguments: q, qd, qdd, tau, u, dq (n numbers each) and z (the friction state). outputs: units by
    name.
    """

    name: str
    about: str
    inputs: tuple[str, ...]
    outputs: dict[str, str]


TORQUE = "Nm, N"

_ENTRY_POINTS = (
    EntryPoint(
        "inverse_dynamics",
        "the torques that give qdd, friction included",
        ("q", "qd", "qdd", "z"),
        {"tau": TORQUE},
    ),
    EntryPoint(
        "forward_dynamics",
        "the accelerations under the torques tau",
        ("q", "qd", "tau", "z"),
        {"qdd": "rad/s^2, m/s^2"},
    ),
    EntryPoint("mass_matrix", "M, armature included", ("q",), {"mass": "kg m^2, kg m, kg"}),
    EntryPoint("bias", "Coriolis, centrifugal and gravity torques", ("q", "qd"), {"bias": TORQUE}),
    EntryPoint("gravity", "the torques that hold the arm still, dV/dq", ("q",), {"gravity": TORQUE}),
    EntryPoint("friction", "the torques of friction", ("q", "qd", "z"), {"friction": TORQUE}),
    EntryPoint(
        "friction_step",
        "the friction state after a displacement dq of each joint",
        ("z", "dq"),
        {"z_next": "rad, m"},
    ),
    EntryPoint(
        "friction_memory",
        "the initial friction state of joints that have moved at constant qd",
        ("qd",),
        {"z_start": "rad, m"},
    ),
    EntryPoint("momentum", "M qd", ("q", "qd"), {"momentum": "Nm s, N s"}),
    EntryPoint("energy", "kinetic energy, then potential", ("q", "qd"), {"energy": "J"}),
    EntryPoint(
        "tip_pose", "the tip's homogeneous transform in the root link's frame", ("q",), {"pose": "1, m"}
    ),
    EntryPoint(
        "tip_jacobian",
        "the tip's linear, then angular velocity by qd, in the root link's axes",
        ("q",),
        {"jacobian": "m, 1"},
    ),
    EntryPoint(
        "inverse_dynamics_derivatives",
        "the derivatives of inverse_dynamics; its derivative by qdd is the mass matrix",
        ("q", "qd", "qdd", "z"),
        {"dtau_dq": "Nm/rad", "dtau_dqd": "Nm s/rad"},
    ),
    EntryPoint(
        "forward_dynamics_derivatives",
        "the derivatives of forward_dynamics",
        ("q", "qd", "tau", "z"),
        {"dqdd_dq": "1/s^2", "dqdd_dqd": "1/s", "dqdd_dtau": "1/(kg m^2)"},
    ),
    EntryPoint(
        "servo_torque",
        "the torques of position servos under a command u, which the caller delays",
        ("u", "q", "qd"),
        {"tau": TORQUE},
    ),
)

ENTRY_POINTS = {entry.name: entry for entry in _ENTRY_POINTS}
"""All entry points by name."""


def entry_points(model: TrainedModel, names: Sequence[str] = ()) -> dict[str, EntryPoint]:
    """Return the selected entry points by name; no names: all except derivatives. Raises RunError for unknown names."""
    available = list(ENTRY_POINTS)
    if model.servos is None:
        available.remove("servo_torque")
    if not names:
        # Derivatives are rarely needed, but would be two thirds of the code.
        names = [name for name in available if not name.endswith("_derivatives")]
    return {name: ENTRY_POINTS[name] for name in select_names(names, available)}


def select_names(names: Sequence[str], available: Iterable[str]) -> list[str]:
    """Return the selected names in the order of `available`; no names: all. Raises RunError for unknown names."""
    options = list(available)
    for name in names:
        if name not in options:
            expected = f"one of {', '.join(options)}"
            raise RunError(f"the function {name!r}", expected=expected)
    # The order does not depend on the user's order, so that the same selection gives the same files.
    return [name for name in options if name in names or not names]
