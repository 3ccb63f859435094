"""The functions that an export contains (entry points), and their comparison with the torch model at random states.

The comparison (parity check) gives the largest difference between an export and the model.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from spelgen.arm.arm import Coordinate
from spelgen.dynamics.prepared import PreparedModel
from spelgen.dynamics.tip import tip_kinematics
from spelgen.errors import RunError
from spelgen.excitation.bounds import SPEEDS
from spelgen.exporting.tuning import TUNING

if TYPE_CHECKING:
    from spelgen.exporting.describe import Trained

Values = dict[str, np.ndarray]
"""Inputs or outputs of an entry point by name, (states, ...) each."""
Called = Callable[[str, Values], Mapping[str, np.ndarray]]
"""Function (name of an entry point, {input: (states, n)}) -> {output: (states, ...)}, computed by an export.

The input z is (states, n, K) for K bristles per joint.
"""


@dataclass(frozen=True)
class EntryPoint:
    """A function of the model that exports contain, such as inverse_dynamics.

    Attributes:
        about: description of the result, such as "the torques that give qdd".
        inputs: names of the arguments, among q, qd, qdd, tau, u (command of servos), dq (displacement), n numbers each,
            and z, the friction state.
        outputs: {name of a result: unit}.
        reference: function that returns the expected result, called as reference(PreparedModel, *inputs) with inputs
            (states, ...); None for a function that only the exported estimator calls.
    """

    name: str
    about: str
    inputs: tuple[str, ...]
    outputs: dict[str, str]
    reference: Callable[..., Tensor] | None


TORQUE = "Nm, N"


def entry_point(
    name: str, about: str, inputs: str, reference: Callable[..., Tensor] | None = None, **outputs: str
) -> EntryPoint:
    """Return an ``EntryPoint``; inputs: names, separated by blanks; outputs: unit of each result.

    The other arguments are fields of the class.
    """
    return EntryPoint(name, about, tuple(inputs.split()), outputs, reference)


def _energy(prepared: PreparedModel, q: Tensor, qd: Tensor) -> Tensor:
    """Return kinetic and potential energy of the torch model, two columns (states, 2) [J], at q and qd, (states, n)."""
    kinetic = 0.5 * (prepared.momentum(q, qd) * qd).sum(dim=-1)
    return torch.stack([kinetic, prepared.model.potential_energy(q)], dim=-1)


_ENTRY_POINTS = (
    entry_point(
        "inverse_dynamics", "the torques that give qdd, friction included", "q qd qdd z",
        PreparedModel.inverse_dynamics, tau=TORQUE,
    ),
    entry_point(
        "forward_dynamics", "the accelerations under the torques tau", "q qd tau z",
        PreparedModel.forward_dynamics, qdd="rad/s^2, m/s^2",
    ),
    entry_point("mass_matrix", "M, armature included", "q", PreparedModel.mass_matrix, mass="kg m^2, kg m, kg"),
    entry_point("bias", "Coriolis, centrifugal and gravity torques", "q qd", PreparedModel.bias, bias=TORQUE),
    entry_point("gravity", "the torques that hold the arm still, dV/dq", "q", PreparedModel.gravity, gravity=TORQUE),
    entry_point("friction", "the torques of friction", "q qd z", PreparedModel.friction_torque, friction=TORQUE),
    entry_point(
        "friction_step", "the friction state after a displacement dq of each joint", "z dq",
        PreparedModel.memory_after, z_next="rad, m",
    ),
    entry_point(
        "friction_memory", "the initial friction state of joints that have moved at constant qd", "qd",
        PreparedModel.memory, z_start="rad, m",
    ),
    entry_point("momentum", "M qd", "q qd", PreparedModel.momentum, momentum="Nm s, N s"),
    entry_point("energy", "kinetic energy, then potential", "q qd", _energy, energy="J"),
    entry_point(
        "tip_pose", "the tip's homogeneous transform in the root link's frame", "q", PreparedModel.pose, pose="1, m",
    ),
    entry_point(
        "tip_jacobian", "the tip's linear, then angular velocity by qd, in the root link's axes", "q",
        PreparedModel.jacobian, jacobian="m, 1",
    ),
    entry_point(
        "servo_torque", "the torques of position servos under a command u, which the caller delays", "u q qd",
        lambda prepared, u, q, qd: prepared.model.servo(u, q, qd), tau=TORQUE,
    ),
)  # fmt: skip

ENTRY_POINTS = {entry.name: entry for entry in _ENTRY_POINTS}
"""All entry points by name."""
PROGRAMS = [name for name in ENTRY_POINTS if name not in ("momentum", "energy", "servo_torque")]
"""The entry points that are exported as torch and ONNX programs."""


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


@dataclass(frozen=True)
class Parity:
    """Result of the comparison of an export with the torch model.

    differences: {entry point: largest difference between export and torch model, divided by the largest value of the
    torch model}. summary: sentence for the user with the largest of these differences.
    """

    differences: dict[str, float]
    summary: str


def require_parity(
    differences: dict[str, float], tolerance: float, states: int, reference: str = "the torch module"
) -> Parity:
    """Return a ``Parity`` with the differences between export and model. Raises RunError if one is above the tolerance.

    Args:
        differences: {entry point: largest relative difference}.
        tolerance: largest allowed relative difference.
        states: number of random states, for the summary.
        reference: name of the dynamics to which the export was compared, for the summary.
    """
    for name, difference in differences.items():
        if not difference <= tolerance:  # The comparison is negated, so that NaN raises the error, too.
            raise RunError(
                f"{name} differs from the model by {difference:.1e}",
                element="parity check",
                expected=f"at most {tolerance:.0e} of the largest value",
                do="nothing was written; please report this with the run folder",
            )
    worst = max(differences, key=differences.__getitem__)
    summary = (
        f"{states} random states: at most {differences[worst]:.1e} ({worst}) from {reference}, "
        f"relative to the largest value; {tolerance:.0e} is allowed"
    )
    return Parity(differences, summary)


def check_parity(
    called: Called,
    trained: Trained,
    names: Sequence[str],
    tolerance: float,
    *,
    states: int = TUNING.states,
    dtype: type = np.float64,
) -> Parity:
    """Compare an export with the torch model at random states; return the differences.

    Args:
        called: function that evaluates an entry point of the export.
        trained: the torch model and its arm.
        names: names of the entry points to compare.
        tolerance: largest allowed difference, relative to the largest value of an output. For programs in float32
            (``trained.float32``), it is `ExportTuning.float32_tolerance`.
        states: number of random states.
        dtype: number type of the export; the inputs of export and torch model are rounded to this type.

    Raises RunError if a difference is above the tolerance.
    """
    if trained.float32:
        tolerance, dtype = TUNING.float32_tolerance, np.float32
    # The torch model computes in double precision, since rounding errors in float32 exceed the tolerance.
    exact = PreparedModel(copy.deepcopy(trained.model).cpu(), tip_kinematics(trained.arm))
    inputs = random_inputs(trained.arm.chain.coordinates, states, exact.n * exact.elements)
    inputs = {key: value.astype(dtype).astype(np.float64) for key, value in inputs.items()}
    inputs["z"] = inputs["z"].reshape(states, exact.n, exact.elements)
    differences = {}
    for name in names:
        entry = ENTRY_POINTS[name]
        (output,) = entry.outputs
        arguments = [torch.from_numpy(inputs[key]) for key in entry.inputs]
        assert entry.reference is not None
        expected = entry.reference(exact, *arguments).detach().numpy()
        # The output of the export is reshaped, since for an arm of one joint some formats return a vector in place of a
        # matrix.
        values = called(name, inputs)[output].reshape(expected.shape)
        differences[name] = relative(values, expected)
    return require_parity(differences, tolerance, states)


def random_inputs(coordinates: Sequence[Coordinate], states: int, memory: int = 0) -> Values:
    """Return {input of the dynamics, such as q: random values for comparisons}, (states, n) each.

    The seed is fixed, so that exports are reproducible. coordinates: joints of the arm, whose limits determine the
    range of positions and velocities. memory: number of values in the friction state z, (states, memory).
    """
    random = np.random.default_rng(0)
    # Most velocities are within the limits, where the model is used: above them, friction is only extrapolated.
    speed = nominal_speeds(coordinates)
    q = np.stack([random.uniform(*joint.working_range, states) for joint in coordinates], axis=-1)
    return {
        "q": q,
        "qd": 0.5 * speed * random.standard_normal(q.shape),
        "qdd": 2.0 * speed * random.standard_normal(q.shape),
        "dq": 0.05 * speed * random.standard_normal(q.shape),
        # The standard deviation of z is 1e-4 rad, as large as typical break-away displacements.
        "z": 1e-4 * random.standard_normal((states, memory)),
        # The accelerations are an affine function of tau: one magnitude of random torques is sufficient.
        "tau": 10.0 * random.standard_normal(q.shape),
        "u": q + 0.3 * random.standard_normal(q.shape),
    }


def nominal_speeds(coordinates: Sequence[Coordinate]) -> np.ndarray:
    """Return a speed per joint, (n,) [rad/s, m/s], as the scale of velocities at which models are compared.

    It is the velocity limit in the URDF. Joints without a limit have the speed limit of exciting motions.
    """
    return np.array([joint.velocity or SPEEDS[joint.joint_type] for joint in coordinates])


def relative(values: np.ndarray, expected: np.ndarray) -> float:
    """Return max |values - expected| / max |expected| of two arrays (...,); NaN if a value is NaN."""
    if not expected.size:
        return 0.0
    # The difference is absolute if all expected values are zero, or rounding errors of zero, such as the gravity torque
    # of a joint with a vertical axis.
    size = np.abs(expected).max()
    size = 1.0 if size < 1e-12 else size
    with np.errstate(invalid="ignore"):
        return float(np.abs(values - expected).max() / size)
