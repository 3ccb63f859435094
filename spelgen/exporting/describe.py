"""A trained model and its arm, the input of every exporter; its description: facts of the arm, values of the model."""

from __future__ import annotations

import copy
import keyword
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from scipy.interpolate import BSpline
from torch import Tensor

from spelgen.arm.arm import make_arm
from spelgen.arm.chain import choose_chain
from spelgen.arm.configured_arm import ConfiguredArm
from spelgen.arm.lump_links import lump_links
from spelgen.dynamics.protocol import input_of, motors_of, residual_terms
from spelgen.dynamics.tip import last_link
from spelgen.errors import RunError
from spelgen.exporting.description import Harmonics, Network, Residuals, Servos, Tip, TrainedModel
from spelgen.exporting.entry_points import EntryPoint, entry_points
from spelgen.runtime.friction_laws import FrictionConstants
from spelgen.runtime.rigid_body_dynamics import RigidBodyDynamics

if TYPE_CHECKING:
    from spelgen.emission.assemble import ArmModel
    from spelgen.runtime.parts import Layers
    from spelgen.runtime.residual_terms import ResidualTerms

_LONGEST_NAME = 40


@dataclass(frozen=True, eq=False)
class Trained:
    """A trained model of an arm.

    entries: names of the functions to export, for formats of functions; by default all but derivatives.
    """

    model: ArmModel
    arm: ConfiguredArm
    entries: tuple[str, ...] = ()

    @cached_property
    def described(self) -> TrainedModel:
        """The model as plain numbers. Raises RunError for a preset that has no such description."""
        return describe(self.model, self.arm)

    @cached_property
    def entry_points(self) -> dict[str, EntryPoint]:
        """The functions to export from the description, by name. Raises RunError for names of others."""
        return entry_points(self.described, self.entries)

    @property
    def robot(self) -> str:
        """The name of the robot in the URDF."""
        return self.arm.arm.name

    @property
    def joint_names(self) -> tuple[str, ...]:
        """The names of the joints in the URDF."""
        return self.arm.arm.joint_names

    @property
    def memory(self) -> int:
        """How many numbers the memory of friction has."""
        model = self.model
        return model.n * model.elements if isinstance(model, RigidBodyDynamics) else 0


def describe(model: ArmModel, loaded: ConfiguredArm) -> TrainedModel:
    """Return the numbers of a trained model of this arm. Raises RunError for a preset without rigid bodies."""
    exact = copy.deepcopy(model).double().cpu().requires_grad_(False)
    if not isinstance(exact, RigidBodyDynamics):
        preset = model.spec.options.preset
        raise RunError(
            f"the preset {preset}, which is not of rigid bodies",
            expected="closed-form or hybrid",
            do="--to torch, onnx, mjcf and urdf take every preset",
        )
    weights = exact.prepare()
    # what does not depend on q is one matrix, whatever it comes from
    constant_mass = array(weights.armature)
    residuals = Residuals((), None, None, {}, (), {})
    if residual_terms(exact) is not None:
        constant_mass += array(weights.residual.constant).reshape(exact.n, exact.n)
        residuals = _residuals(exact)
    return TrainedModel(
        name=identifier(loaded.arm.name),
        arm=loaded.arm,
        identifiers=unique_identifiers(model.joint_names),
        inertias=array(exact.inertial_parameters),
        constant_mass=constant_mass,
        motors=array(motors_of(exact)),
        residuals=residuals,
        friction=FrictionConstants._make(map(array, weights.friction)),
        reach=array(exact.friction.reach),
        inputs=array(exact.input_matrix(torch.zeros(exact.n).double())),
        actuated=array(exact.actuated),
        torque_offset=array(exact.torque_offset),
        friction_compensation=array(exact.friction_compensation),
        tip=tip_frame(loaded),
        servos=servos_of(exact),
    )


def identifier(text: str) -> str:
    """Return ASCII letters, digits and underscores of a text: a name that any language takes."""
    plain = re.sub(r"[^0-9a-z]+", "_", text.lower()).strip("_")[:_LONGEST_NAME]
    if not plain or plain[0].isdigit() or keyword.iskeyword(plain):
        return f"arm_{plain}".rstrip("_")
    return plain


def unique_identifiers(names: Sequence[str]) -> tuple[str, ...]:
    """Return an identifier for each joint, recognisable if the name allows it, that no other joint has."""
    found: list[str] = []
    for number, name in enumerate(names, start=1):
        plain = re.sub(r"[^0-9a-z]+", "_", name.lower()).strip("_")[:_LONGEST_NAME]
        if not plain or keyword.iskeyword(plain) or keyword.issoftkeyword(plain) or plain[0].isdigit():
            plain = f"joint_{plain or number}"
        unique, count = plain, 2
        while unique in found:
            unique, count = f"{plain}_{count}", count + 1
        found.append(unique)
    return tuple(found)


def array(value: Tensor) -> np.ndarray:
    """Return the numbers of a tensor, float64."""
    values: np.ndarray = value.detach().double().cpu().numpy().copy()
    return values


def servos_of(model: ArmModel) -> Servos | None:
    """Return the position servos of a model, None where it has none."""
    if input_of(model) == "torque":
        return None
    kp, kd, limit, dead_zone = map(array, model.servo.prepare())
    return Servos(kp, kd, limit, dead_zone, float(model.servo.delay))


def tip_frame(loaded: ConfiguredArm) -> Tip:
    """Return the frame of the tip's link behind the body that carries it, by the angles that the URDF has."""
    names = loaded.arm.joint_names
    link = loaded.tip or last_link(loaded.robot, names)
    frame = lump_links(loaded.robot, choose_chain(loaded.robot, names, None), 0.0).frames[link]
    pose = np.eye(4)
    pose[:3, :3] = frame.rotation
    pose[:3, 3] = frame.position
    bodies = make_arm(loaded.robot, joints=names, angle_tolerance=0.0).bodies
    return Tip(link, frame.body, pose, bodies)


def _residuals(model: ArmModel) -> Residuals:
    """Return the residuals without those that are zero."""
    terms, weights = model.residuals, model.prepare().residual
    functions = array(weights.functions)
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


def _network(layers: Layers | None, encoding: Any, functions: np.ndarray | None = None) -> Network | None:
    """Return a network y, None where there is none or its last layer is zero; with functions, tanh(y) @ functions.

    Its units are sigmoids, which C computes faster than tanh.
    """
    if layers is None or not any(tensor.any() for tensor in layers[-1]):
        return None
    weights, biases = [], []
    for weight, bias in layers:
        weights.append(array(weight))
        biases.append(array(bias))
    # of cos q, sin q and q in place of cos q or (q - center) slope, and sin q or zero
    first, second = np.hsplit(weights[0], 2)
    slopes, revolute = first * array(encoding.slope), array(encoding.revolute)
    weights[0] = np.hstack([first * revolute, second * revolute, slopes])
    biases[0] -= slopes @ array(encoding.center)
    if functions is not None:
        weights.append(functions.T)
        biases.append(np.zeros(functions.shape[1]))
    # tanh x is 2 sigmoid(2 x) - 1
    for k in range(1, len(weights)):
        weights[k - 1], biases[k - 1] = 2 * weights[k - 1], 2 * biases[k - 1]
        weights[k], biases[k] = 2 * weights[k], biases[k] - weights[k].sum(axis=1)
    return Network(tuple(weights), tuple(biases))


def _splines(terms: ResidualTerms, weights: Tensor) -> dict[int, BSpline]:
    """Return the sums of splines of the joints that have one."""
    splines = {}
    for joint in torch.nonzero(weights.any(dim=1)).flatten().tolist():
        # three weights of zero at either end: there the curve comes from zero and goes to it
        padded = np.pad(array(weights[joint]), 3)
        steps = np.arange(len(padded) + 4) - 5
        knots = float(terms.middles[joint, 0]) + float(terms.spacing[joint, 0]) * steps
        splines[joint] = BSpline(knots, padded, 3)
    return splines


def _ripple(terms: ResidualTerms, weights: Tensor) -> tuple[Harmonics, ...]:
    """Return by joint the multiples of a turn, then, where they stand for themselves, those of the motor's turn."""
    ripple: list[Harmonics] = []
    cosines, sines = map(array, weights.chunk(2, dim=-1))
    for joint, frequencies in enumerate(array(terms.frequencies)):
        count = len(frequencies)
        # how many follow one another from one on
        regular = int(np.argmin(frequencies == np.arange(1, count + 1))) or count
        for block in (slice(0, regular), slice(regular, count)):
            c, s = cosines[joint, block], sines[joint, block]
            # a phasor turns from one on: zeros between stay, those behind go
            used = np.flatnonzero((c != 0) | (s != 0))
            if used.size:
                last = used[-1] + 1
                ripple.append(Harmonics(joint, float(frequencies[block][0]), c[:last], s[:last]))
    return tuple(ripple)
