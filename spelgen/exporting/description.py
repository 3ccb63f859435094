"""A trained model as NumPy arrays (``TrainedModel``), and the functions that an export contains (entry points)."""

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
    """A network with layers of sigmoids, then a linear layer. Its inputs are cos q, sin q and q of all joints, (3 n,).

    weights: one matrix per layer, (units, units of the previous layer). biases: one vector per layer, (units,).
    """

    weights: tuple[np.ndarray, ...]
    biases: tuple[np.ndarray, ...]


@dataclass(frozen=True, eq=False)
class Harmonics:
    """Torque ripple of one joint [Nm], as a function of its position q [rad].

    The torque is the sum of cosines[k - 1] cos(k frequency q) + sines[k - 1] sin(k frequency q) over k = 1, 2, ...
    """

    joint: int
    frequency: float
    cosines: np.ndarray
    sines: np.ndarray


@dataclass(frozen=True, eq=False)
class Residuals:
    """The nonzero residual terms of a model, which are added to its rigid bodies.

    Splines are cubic, and zero outside of their knots.

    Attributes:
        mass: network whose outputs are added to M.
        entries: (row, column) in the lower triangle of M to which each output is added.
        potential: network whose output is added to V.
        torque: {joint: spline of q that is added to dV/dq [Nm, N]}.
        ripple: harmonics in the position of a joint that are added to dV/dq [Nm].
        friction: {joint: spline of q, logarithm of the factor on the friction of the joint's drive}.
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
        """True if any joint has a residual torque that depends on its position, a spline or ripple."""
        return bool(self.torque or self.ripple)


def spline_energy(spline: BSpline) -> BSpline:
    """Return the potential energy [J] of a torque spline as a function of q, its antiderivative.

    As in the runtime, its constant is chosen such that the energies at both ends differ only in sign.
    """
    energy = spline.antiderivative()
    count = len(energy.t) - energy.k - 1
    half = energy(spline.t[-4]) / 2
    return BSpline(energy.t, energy.c[:count] - half, energy.k)


@dataclass(frozen=True, eq=False)
class Servos:
    """Constants of position servos, (n,) each, as in ``runtime.PositionServo``.

    Attributes:
        kp, kd: gains [Nm/rad, N/m] and [Nm s/rad, N s/m].
        limit: largest torque [Nm, N]; infinite for a servo without a limit.
        dead_zone: half the width of the dead zone [rad, m].
        delay: delay of the commands [s], one number.
    """

    kp: np.ndarray
    kd: np.ndarray
    limit: np.ndarray
    dead_zone: np.ndarray
    delay: float


@dataclass(frozen=True, eq=False)
class TrainedModel:
    """A trained model of an arm with n joints: rad and Nm for revolute joints, m and N for prismatic joints.

    Attributes:
        name: identifier of the robot in code.
        arm: kinematic chain of the arm.
        joint_labels: names of the joints for comments, only letters, digits and _.
        inertias: (bodies, 10), inertial parameters in the frames of the joints.
        constant_mass: (n, n), armature and constant residual terms of M.
        motors: C, (n, n), motor velocities = C qd.
        residuals: residual terms that depend on q.
        friction: the ``FrictionConstants`` of the runtime, as arrays.
        breakaway: (n, K) [rad, m], break-away displacements of K bristles per joint.
        inputs: G, (n, n), joint torques = G times motor torques.
        actuated: (n,), 0 for a passive joint, otherwise 1.
        torque_offset: (n,), measured torque at zero torque.
        friction_compensation: (n,) [Nm s/rad, N s/m], coefficient of a torque proportional to qd that the drives add
            without measuring it.
        tip: frame of the tip.
        servos: position servos of the joints; None for an arm under torques.
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
        """Number of joints of the arm."""
        return len(self.arm.coordinates)

    @property
    def memory(self) -> int:
        """Number of friction bristles of all joints, the size of the friction state z; 0 without a state."""
        return int(self.breakaway.size)

    @property
    def input_inverse(self) -> np.ndarray:
        """Matrix (n, n) from joint torques to motor torques: inverse of G with 1 on the diagonal for passive joints."""
        return np.linalg.inv(self.inputs + np.diag(1 - self.actuated))


@dataclass(frozen=True)
class EntryPoint:
    """A function of the model that exports contain, such as inverse_dynamics.

    Attributes:
        about: description.
        inputs: names of the arguments, among q, qd, qdd, tau, u (command of servos), dq (displacement), n numbers each,
            and z, the friction state.
        outputs: {name of a result: unit}.
    """

    name: str
    about: str
    inputs: tuple[str, ...]
    outputs: dict[str, str]


TORQUE = "Nm, N"


def entry_point(name: str, about: str, inputs: str, **outputs: str) -> EntryPoint:
    """Return an ``EntryPoint``; inputs: names, separated by blanks; outputs: unit of each result."""
    return EntryPoint(name, about, tuple(inputs.split()), outputs)


_ENTRY_POINTS = (
    entry_point("inverse_dynamics", "the torques that give qdd, friction included", "q qd qdd z", tau=TORQUE),
    entry_point("forward_dynamics", "the accelerations under the torques tau", "q qd tau z", qdd="rad/s^2, m/s^2"),
    entry_point("mass_matrix", "M, armature included", "q", mass="kg m^2, kg m, kg"),
    entry_point("bias", "Coriolis, centrifugal and gravity torques", "q qd", bias=TORQUE),
    entry_point("gravity", "the torques that hold the arm still, dV/dq", "q", gravity=TORQUE),
    entry_point("friction", "the torques of friction", "q qd z", friction=TORQUE),
    entry_point("friction_step", "the friction state after a displacement dq of each joint", "z dq", z_next="rad, m"),
    entry_point(
        "friction_memory", "the initial friction state of joints that have moved at constant qd", "qd",
        z_start="rad, m",
    ),
    entry_point("momentum", "M qd", "q qd", momentum="Nm s, N s"),
    entry_point("energy", "kinetic energy, then potential", "q qd", energy="J"),
    entry_point("tip_pose", "the tip's homogeneous transform in the root link's frame", "q", pose="1, m"),
    entry_point(
        "tip_jacobian", "the tip's linear, then angular velocity by qd, in the root link's axes", "q",
        jacobian="m, 1",
    ),
    entry_point(
        "servo_torque", "the torques of position servos under a command u, which the caller delays", "u q qd",
        tau=TORQUE,
    ),
)  # fmt: skip

ENTRY_POINTS = {entry.name: entry for entry in _ENTRY_POINTS}
"""All entry points by name."""


def select_names(names: Sequence[str], available: Iterable[str]) -> list[str]:
    """Return the `names` of functions in the order of `available`; if `names` is empty, all available ones.

    Raises RunError for names that are not available.
    """
    options = list(available)
    for name in names:
        if name not in options:
            expected = f"one of {', '.join(options)}"
            raise RunError(f"the function {name!r}", expected=expected)
    # The functions have a fixed order, not the user's order, so that the same selection gives the same files.
    return [name for name in options if name in names or not names]
