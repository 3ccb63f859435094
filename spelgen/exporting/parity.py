"""Parity check: the largest difference between an export and the torch model at random states."""

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from spelgen.arm.arm import Coordinate
from spelgen.dynamics.prepared import PreparedModel
from spelgen.dynamics.tip import tip_kinematics
from spelgen.errors import RunError
from spelgen.excitation.bounds import SPEEDS
from spelgen.exporting.describe import Trained
from spelgen.exporting.description import ENTRY_POINTS
from spelgen.exporting.tuning import TUNING

Values = dict[str, np.ndarray]
"""Inputs or outputs of an entry point by name, (states, ...) each."""
Called = Callable[[str, Values], Mapping[str, np.ndarray]]
"""Function (name of an entry point, {input: (states, n)}) -> {output: (states, ...)}, computed by an export.

The input z is (states, n, K) for K bristles per joint.
"""


PROGRAMS: dict[str, Callable[..., Tensor]] = {
    "inverse_dynamics": PreparedModel.inverse_dynamics,
    "forward_dynamics": PreparedModel.forward_dynamics,
    "mass_matrix": PreparedModel.mass_matrix,
    "bias": PreparedModel.bias,
    "gravity": PreparedModel.gravity,
    "friction": PreparedModel.friction_torque,
    "friction_step": PreparedModel.memory_after,
    "friction_memory": PreparedModel.memory,
    "tip_pose": PreparedModel.pose,
    "tip_jacobian": PreparedModel.jacobian,
}
"""The entry points that are exported as torch and ONNX programs, and the methods that compute them."""


def _energy(prepared: PreparedModel, q: Tensor, qd: Tensor) -> Tensor:
    """Return kinetic and potential energy of the torch model, two columns (states, 2) [J], at q and qd, (states, n)."""
    kinetic = 0.5 * (prepared.momentum(q, qd) * qd).sum(dim=-1)
    return torch.stack([kinetic, prepared.model.potential_energy(q)], dim=-1)


_REFERENCES = PROGRAMS | {
    "momentum": PreparedModel.momentum,
    "energy": _energy,
    "servo_torque": lambda prepared, u, q, qd: prepared.model.servo(u, q, qd),
}
"""The torch model's functions of entry points, by name."""


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
    """Return the differences between export and model as a ``Parity``. Raises RunError if one is above the tolerance.

    differences: {entry point: largest relative difference}. states, reference: number of random states and name of the
    compared dynamics, for the summary.
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
        tolerance: largest allowed difference, relative to the largest value of an output.
        states: number of random states.
        dtype: number type of the export; the inputs of export and torch model are rounded to this type.

    Raises RunError if a difference is above the tolerance.
    """
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
        expected = _REFERENCES[name](exact, *arguments).detach().numpy()
        # The output of the export is reshaped, since for an arm of one joint some formats return a vector in place of a
        # matrix.
        values = called(name, inputs)[output].reshape(expected.shape)
        differences[name] = relative(values, expected)
    return require_parity(differences, tolerance, states)


def random_inputs(coordinates: Sequence[Coordinate], states: int, memory: int = 0) -> Values:
    """Return {input of the dynamics, such as q: random values for comparisons}, (states, n) each.

    The friction state z is (states, memory). The seed is fixed, so that exports are reproducible. memory: number of
    values in the friction state z.
    """
    random = np.random.default_rng(0)
    # Velocities are mostly within the limits, because friction at higher speeds is extrapolated.
    speed = nominal_speeds(coordinates)
    q = np.stack([random.uniform(*joint.working_range, states) for joint in coordinates], axis=-1)
    return {
        "q": q,
        "qd": 0.5 * speed * random.standard_normal(q.shape),
        "qdd": 2.0 * speed * random.standard_normal(q.shape),
        "dq": 0.05 * speed * random.standard_normal(q.shape),
        # The standard deviation of the friction state z has the size of break-away displacements, fractions of a
        # milliradian.
        "z": 1e-4 * random.standard_normal((states, memory)),
        # Forward dynamics are linear in tau, so the size of tau has no influence on the relative difference.
        "tau": 10.0 * random.standard_normal(q.shape),
        "u": q + 0.3 * random.standard_normal(q.shape),
    }


def nominal_speeds(coordinates: Sequence[Coordinate]) -> np.ndarray:
    """Return the velocity limits of the joints in the URDF, (n,) [rad/s, m/s], to scale random velocities.

    Joints without a limit have the speed limit of exciting motions.
    """
    return np.array([joint.velocity or SPEEDS[joint.joint_type] for joint in coordinates])


def relative(values: np.ndarray, expected: np.ndarray) -> float:
    """Return max |values - expected| / max |expected| of two arrays (...,); NaN if a value is NaN."""
    if not expected.size:
        return 0.0
    # The difference is absolute if all expected values are zero.
    size = np.abs(expected).max() or 1.0
    with np.errstate(invalid="ignore"):
        return float(np.abs(values - expected).max() / size)
