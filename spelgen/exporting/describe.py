"""``Trained``, a model with its arm, which every exporter gets as argument, and its conversion to NumPy arrays."""

import copy
import keyword
import re
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from scipy.interpolate import BSpline
from torch import Tensor

from spelgen.arm.configured_arm import Arm
from spelgen.dynamics.protocol import motors_of, residual_terms
from spelgen.dynamics.tip_frame import tip_frame
from spelgen.emission.assemble import ArmModel
from spelgen.errors import RunError
from spelgen.exporting import description
from spelgen.listing import Listing
from spelgen.live.noise import NoiseLevels
from spelgen.runtime.friction_laws import FrictionConstants
from spelgen.runtime.networks import JointEncoding
from spelgen.runtime.parts import Layers
from spelgen.runtime.residual_terms import ResidualTerms
from spelgen.runtime.rigid_body_dynamics import RigidBodyDynamics


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
    def described(self) -> description.TrainedModel:
        """The trained model with NumPy arrays in place of PyTorch modules.

        Raises RunError for a model without rigid bodies.
        """
        return describe(self.model, self.arm)

    @cached_property
    def entry_points(self) -> dict[str, description.EntryPoint]:
        """The functions of the model to export, by name, such as inverse_dynamics.

        Raises RunError for unknown names in ``entries``.
        """
        available = list(description.ENTRY_POINTS)
        if self.described.servos is None:
            available.remove("servo_torque")
        names = description.select_names(self.entries, available)
        return {name: description.ENTRY_POINTS[name] for name in names}


def describe(model: ArmModel, loaded: Arm) -> description.TrainedModel:
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
    residuals = description.Residuals((), None, None, {}, (), {})
    # The constant part of a residual term of M is added to the armature: exports evaluate only the varying part.
    if residual_terms(exact) is not None:
        constant_mass += array(weights.residual.constant).reshape(exact.n, exact.n)
        residuals = _residuals(exact)
    return description.TrainedModel(
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


def servos_of(model: ArmModel) -> description.Servos | None:
    """Return the constants of the position servos of a model as NumPy arrays; None for a model under torques."""
    if model.input_quantity == "torque":
        return None
    kp, kd, limit, dead_zone = map(array, model.servo.prepare())
    return description.Servos(kp, kd, limit, dead_zone, float(model.servo.delay))


def _residuals(model: ArmModel) -> description.Residuals:
    """Return the residual terms of a model as NumPy arrays and splines, without the terms that are zero."""
    terms, weights = model.residuals, model.prepare().residual
    functions = array(weights.functions)
    # The residual term of M is a sum of functions; entries to which no function contributes are omitted.
    entries: np.ndarray = np.argwhere(np.tril(functions.any(axis=0).reshape(model.n, model.n)))
    mass = _network(weights.mass, terms.encoding, functions[:, entries @ (model.n, 1)])
    if mass is None:
        entries = entries[:0]
    return description.Residuals(
        entries=tuple(map(tuple, entries.tolist())),
        mass=mass,
        potential=_network(weights.potential, terms.encoding),
        torque=_splines(terms, terms.unit * terms.raw_torque_splines),
        ripple=_ripple(terms, weights.ripple),
        friction=_splines(terms, terms.friction_logarithms()),
    )


def _network(
    layers: Layers | None, encoding: JointEncoding, functions: np.ndarray | None = None
) -> description.SigmoidNetwork | None:
    """Return a network of tanh units as a network of sigmoids; None if it has no layers or a zero last layer.

    The result computes y(q), the outputs of the given network, or tanh(y(q)) @ functions. Sigmoids take less time in C.
    The factors and the shift in tanh(x) = 2 sigmoid(2 x) - 1 are included in the weights and biases of the adjacent
    layers.

    Args:
        layers: weights and biases of the layers of tanh units, and of the last layer, which is linear.
        encoding: the inputs of the given network, (2 n,). A revolute joint has the inputs cos q and sin q, a prismatic
            joint (q - center) slope and zero.
        functions: linear map of tanh(y), (outputs of the last layer, outputs); None: the result is y.
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
    return description.SigmoidNetwork(tuple(weights), tuple(biases))


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


def _ripple(terms: ResidualTerms, weights: Tensor) -> tuple[description.Harmonics, ...]:
    """Return the torque ripple of all joints: up to two elements per joint, for harmonics of joint and motor.

    terms: residual terms, for the frequencies. weights: (n, 2 H), coefficients of H cosines, then of H sines. The H
    frequencies are harmonics of a revolution of the joint, then harmonics of a revolution of the motor. An export
    computes the harmonics k = 1, 2, ... of one frequency in sequence. Harmonics with zero amplitude are therefore
    removed only after the last nonzero one.
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
            # Each harmonic costs computing time in the exported code, so trailing harmonics with zero amplitude are
            # removed.
            if used.size:
                last = used[-1] + 1
                ripple.append(description.Harmonics(joint, float(frequencies[block][0]), c[:last], s[:last]))
    return tuple(ripple)
