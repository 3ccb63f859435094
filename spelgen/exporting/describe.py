"""``Trained``, the argument of all exporters (model and arm), and ``TrainedModel``, the model as NumPy arrays."""

import copy
import keyword
import re
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from scipy.interpolate import BSpline
from torch import Tensor

from spelgen.arm.arm import Chain
from spelgen.arm.configured_arm import Arm
from spelgen.dynamics.protocol import motors_of, residual_terms
from spelgen.dynamics.tip_frame import Tip, tip_frame
from spelgen.emission.assemble import ArmModel
from spelgen.errors import RunError
from spelgen.exporting.parity import ENTRY_POINTS, EntryPoint, select_names
from spelgen.listing import Listing
from spelgen.live.noise import NoiseLevels
from spelgen.runtime.friction_laws import FrictionConstants
from spelgen.runtime.networks import JointEncoding
from spelgen.runtime.parts import Layers
from spelgen.runtime.residual_terms import ResidualTerms
from spelgen.runtime.rigid_body_dynamics import RigidBodyDynamics


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
        torque_offset: (n,), measured torque of a motor that exerts no torque.
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


@dataclass(frozen=True, eq=False)
class Trained:
    """A trained model, its arm, and options of the export.

    Attributes:
        model: the trained model.
        arm: arm of the model.
        entries: names of the functions to export, for formats that consist of functions; empty: all.
        intervals: tables of the fitted parameters with 95 % intervals, for the README.
        float32: whether ONNX and torch programs compute in float32; otherwise in float64.
        levels: noise levels of the estimator of payload and external torques; None: the estimator is not exported.
    """

    model: ArmModel
    arm: Arm
    entries: tuple[str, ...] = ()
    intervals: tuple[Listing, ...] = ()
    float32: bool = False
    levels: NoiseLevels | None = None

    @cached_property
    def described(self) -> TrainedModel:
        """The trained model with NumPy arrays in place of PyTorch modules.

        Raises RunError for a model without rigid bodies.
        """
        return describe(self.model, self.arm)

    @cached_property
    def entry_points(self) -> dict[str, EntryPoint]:
        """The functions of the model to export, by name, such as inverse_dynamics.

        Raises RunError for unknown names in ``entries``.
        """
        available = list(ENTRY_POINTS)
        if self.described.servos is None:
            available.remove("servo_torque")
        names = select_names(self.entries, available)
        return {name: ENTRY_POINTS[name] for name in names}


def describe(model: ArmModel, loaded: Arm) -> TrainedModel:
    """Return a trained model as NumPy arrays, from which C and CasADi code is generated.

    Raises RunError for a model without rigid bodies. loaded: arm of the model.
    """
    # The arrays are made from a copy in double precision on the CPU: the user's model may be in single precision or on
    # a GPU.
    exact = copy.deepcopy(model).double().cpu().requires_grad_(False)
    if not isinstance(exact, RigidBodyDynamics):
        preset = model.spec.options.preset
        raise RunError(
            f"the preset {preset}, which is not of rigid bodies",
            expected="closed-form or hybrid",
            do="--to torch, onnx, mjcf and urdf take every preset",
        )
    weights = exact.prepare()
    constant_mass = array(weights.armature)
    residuals = Residuals((), None, None, {}, (), {})
    # The constant part of a residual term of M is added to the armature: exports evaluate only the varying part.
    if residual_terms(exact) is not None:
        constant_mass += array(weights.residual.constant).reshape(exact.n, exact.n)
        residuals = _residuals(exact)
    return TrainedModel(
        name=identifier(loaded.chain.name),
        arm=loaded.chain,
        joint_labels=tuple(_letters_and_digits(name) or "joint" for name in model.joint_names),
        inertias=array(exact.inertial_parameters),
        constant_mass=constant_mass,
        motors=array(motors_of(exact)),
        residuals=residuals,
        friction=FrictionConstants._make(map(array, weights.friction)),
        breakaway=array(exact.friction.reach),
        inputs=array(exact.input_matrix(torch.zeros(exact.n).double())),
        actuated=array(exact.actuated),
        torque_offset=array(exact.torque_offset),
        friction_compensation=array(exact.friction_compensation),
        tip=tip_frame(loaded),
        servos=servos_of(exact),
    )


def identifier(text: str) -> str:
    """Return `text` as an identifier that is valid in all exported languages: ASCII letters, digits and _."""
    plain = _letters_and_digits(text)
    if not plain or plain[0].isdigit() or keyword.iskeyword(plain):
        return f"arm_{plain}".rstrip("_")
    return plain


def _letters_and_digits(text: str) -> str:
    # The names of all functions and macros of an export start with this text, which is therefore limited to 40
    # characters.
    return re.sub(r"[^0-9a-z]+", "_", text.lower()).strip("_")[:40]


def array(value: Tensor) -> np.ndarray:
    """Return a copy of a tensor (...,) as a float64 array of the same shape."""
    return np.array(value.detach().double().cpu().numpy())


def servos_of(model: ArmModel) -> Servos | None:
    """Return the constants of the position servos of a model as NumPy arrays; None for a model under torques."""
    if model.input_quantity == "torque":
        return None
    kp, kd, limit, dead_zone = map(array, model.servo.prepare())
    return Servos(kp, kd, limit, dead_zone, float(model.servo.delay))


def _residuals(model: ArmModel) -> Residuals:
    """Return the residual terms of a model as NumPy arrays and splines, without the terms that are zero."""
    terms, weights = model.residuals, model.prepare().residual
    functions = array(weights.functions)
    # The residual term of M is a sum of functions; entries to which no function contributes are omitted.
    entries: np.ndarray = np.argwhere(np.tril(functions.any(axis=0).reshape(model.n, model.n)))
    mass = _network(weights.mass, terms.encoding, functions[:, entries @ (model.n, 1)])
    if mass is None:
        entries = entries[:0]
    return Residuals(
        entries=tuple(map(tuple, entries.tolist())),
        mass=mass,
        potential=_network(weights.potential, terms.encoding),
        torque=_splines(terms, terms.unit * terms.raw_torque_splines),
        ripple=_ripple(terms, weights.ripple),
        friction=_splines(terms, terms.friction_logarithms()),
    )


def _network(
    layers: Layers | None, encoding: JointEncoding, functions: np.ndarray | None = None
) -> SigmoidNetwork | None:
    """Return a network of tanh units as a network of sigmoids; None if it has no layers or a zero last layer.

    Let y(q) be the outputs of the given network. The result computes y(q) or, with ``functions``, tanh(y(q)) @
    functions: the entries of R, the residual term of M. Sigmoids take less time in C. The factors and the shift in
    tanh(x) = 2 sigmoid(2 x) - 1 are included in the weights and biases of the adjacent layers.

    Args:
        layers: weights and biases of the layers of tanh units, and of the last layer, which is linear.
        encoding: the inputs of the given network, (2 n,). A revolute joint has the inputs cos q and sin q, a prismatic
            joint (q - center) slope and zero.
        functions: matrix (k, m), entries of R per function tanh(y_i), for k elements of y and m entries of R; None: the
            result is y.
    """
    if layers is None or not any(tensor.any() for tensor in layers[-1]):
        return None
    weights, biases = (list(map(array, tensors)) for tensors in zip(*layers, strict=True))
    # The exported network has the inputs (cos q, sin q, q) of all joints.
    first, second = np.hsplit(weights[0], 2)
    # The input (q - center) slope of a prismatic joint becomes a weight of q and a contribution to the bias.
    slopes, revolute = first * array(encoding.slope), array(encoding.revolute)
    weights[0] = np.hstack([first * revolute, second * revolute, slopes])
    biases[0] -= slopes @ array(encoding.center)
    if functions is not None:
        weights.append(functions.T)
        biases.append(np.zeros(functions.shape[1]))
    for k in range(1, len(weights)):
        # For tanh(x) = 2 sigmoid(2 x) - 1, weights and biases of the layer before the unit are doubled. In the layer
        # after it, the weights are doubled, and the sum of the original weights is subtracted from the bias.
        weights[k - 1], biases[k - 1] = 2 * weights[k - 1], 2 * biases[k - 1]
        weights[k], biases[k] = 2 * weights[k], biases[k] - weights[k].sum(axis=1)
    return SigmoidNetwork(tuple(weights), tuple(biases))


def _splines(terms: ResidualTerms, weights: Tensor) -> dict[int, BSpline]:
    """Return the residual splines of joints: {index of a joint: cubic spline of q}, without splines that are zero.

    terms: residual terms, for the knots. weights: coefficients of the B-splines of each joint, (n, splines).
    """
    splines = {}
    for joint in torch.nonzero(weights.any(dim=1)).flatten().tolist():
        # With three zero coefficients at each end, the spline and its first two derivatives are zero at both ends.
        padded = np.pad(array(weights[joint]), 3)
        steps = np.arange(len(padded) + 4) - 5
        knots = float(terms.middles[joint, 0]) + float(terms.spacing[joint, 0]) * steps
        splines[joint] = BSpline(knots, padded, 3)
    return splines


def _ripple(terms: ResidualTerms, weights: Tensor) -> tuple[Harmonics, ...]:
    """Return the torque ripple of all joints: up to two elements per joint, for harmonics of joint and motor.

    terms: residual terms, for the frequencies. weights: (n, 2 H), coefficients of H cosines, then of H sines. The first
    frequencies are harmonics of the joint (k per joint revolution), the others are harmonics of the motor (k per motor
    revolution), k = 1, 2, ... An export computes all harmonics up to the last one, so a harmonic with zero amplitude is
    removed only if all higher harmonics are zero, too.
    """
    ripple = []
    cosines, sines = map(array, weights.chunk(2, dim=-1))
    for joint, frequencies in enumerate(array(terms.frequencies)):
        count = len(frequencies)
        # `regular` is the number of harmonics of the joint, whose frequencies are 1, 2, ... per revolution. The other
        # frequencies are multiples of the gear ratio: harmonics of the motor.
        regular = int(np.argmin(frequencies == np.arange(1, count + 1))) or count
        for block in (slice(0, regular), slice(regular, count)):
            c, s = cosines[joint, block], sines[joint, block]
            used = np.flatnonzero((c != 0) | (s != 0))
            # The exported code computes every harmonic up to the last one, so trailing harmonics with zero amplitude
            # are removed.
            if used.size:
                last = used[-1] + 1
                ripple.append(Harmonics(joint, float(frequencies[block][0]), c[:last], s[:last]))
    return tuple(ripple)
