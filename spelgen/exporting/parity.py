"""The parity check: the largest difference between an export and the torch model at random states."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from spelgen.arm.arm import Coordinate
from spelgen.dynamics.prepared import batched_jacobians
from spelgen.dynamics.tip import tip_kinematics
from spelgen.errors import RunError
from spelgen.exporting.describe import Trained
from spelgen.exporting.entry_points import ENTRY_POINTS
from spelgen.exporting.tuning import TUNING
from spelgen.structure.nominal import working_range

if TYPE_CHECKING:
    from spelgen.emission.assemble import ArmModel

_USUAL_SPEED = {"revolute": 1.0, "prismatic": 0.3}  # rad/s, m/s where the URDF names none

_METHODS = {
    "bias": "nonlinear_effects",
    "friction": "friction_torque",
    "friction_step": "memory_after",
    "friction_memory": "memory",
    "servo_torque": "servo",
}
"""The model's names of entry points, where they are others."""

Values = dict[str, np.ndarray]
Called = Callable[[str, Values], Mapping[str, np.ndarray]]
"""An export: takes an entry point's name and its inputs, (states, n) each, to its outputs, (states, ...)."""


@dataclass(frozen=True)
class Parity:
    """The largest difference to the torch model by entry point, relative to the largest value; a sentence on them."""

    differences: dict[str, float]
    summary: str


def require_parity(differences: dict[str, float], tolerance: float, states: int) -> Parity:
    """Return the differences at so many states. Raises RunError where one is larger than allowed."""
    # what the tip is compared with rounds
    tolerances = {
        name: max(tolerance, TUNING.tip_tolerance) if name.startswith("tip_") else tolerance
        for name in differences
    }
    for name, difference in differences.items():
        if not difference <= tolerances[name]:  # NaN is refused as well
            raise RunError(
                f"{name} differs from the model by {difference:.1e}",
                element="parity check",
                expected=f"at most {tolerances[name]:.0e} of the largest value",
                do="nothing was written; please report this with the run folder",
            )
    worst = max(differences, key=lambda name: differences[name] / tolerances[name])
    summary = (
        f"{states} random states: at most {differences[worst]:.1e} ({worst}) from the torch module, "
        f"relative to the largest value; {tolerances[worst]:.0e} is allowed"
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
    """Compare ``called`` with the torch model at random states, at each of these entry points. Raises RunError.

    dtype: of the export, to which the states are rounded for both.
    """
    inputs = random_inputs(trained.arm.arm.coordinates, states, trained.memory)
    inputs = {key: value.astype(dtype).astype(np.float64) for key, value in inputs.items()}
    # float32 of a model on another device would be the larger error
    exact = copy.deepcopy(trained.model).double().cpu().requires_grad_(False)
    differences: dict[str, float] = {}
    for name in names:
        outputs = called(name, inputs)
        expected = _expected(exact, trained, name, inputs)
        # of one joint a matrix and a vector are one number, whichever a format makes of it
        errors = [relative(outputs[key].reshape(value.shape), value) for key, value in expected.items()]
        differences[name] = float(np.max(errors))  # NaN wins
    return require_parity(differences, tolerance, states)


def random_inputs(coordinates: Sequence[Coordinate], states: int, memory: int = 0) -> Values:
    """Return states over the joints' ranges at their usual speeds, (states, n) each, and z, (states, memory)."""
    # the same states each time: an export is reproducible
    random = np.random.default_rng(0)
    speed = usual_speeds(coordinates)
    q = np.stack([random.uniform(*working_range(joint), states) for joint in coordinates], axis=-1)
    return {
        "q": q,
        "qd": 0.5 * speed * random.standard_normal(q.shape),
        "qdd": 2.0 * speed * random.standard_normal(q.shape),
        "dq": 0.05 * speed * random.standard_normal(q.shape),
        # bristles bend by fractions of a milliradian before they slide
        "z": 1e-4 * random.standard_normal((states, memory)),
        "tau": 10.0 * random.standard_normal(q.shape),
        "u": q + 0.3 * random.standard_normal(q.shape),
    }


def usual_speeds(coordinates: Sequence[Coordinate]) -> np.ndarray:
    """Return the URDF's limits of velocity, or usual speeds where it has none, (n,) [rad/s, m/s]."""
    return np.array([joint.velocity or _USUAL_SPEED[joint.kind] for joint in coordinates])


def relative(values: np.ndarray, expected: np.ndarray) -> float:
    """Return the largest difference, relative to the largest value; NaN where one is NaN."""
    if not expected.size:
        return 0.0
    # a quantity that is zero everywhere is compared as it is
    size = np.abs(expected).max() or 1.0
    with np.errstate(invalid="ignore"):
        return float(np.abs(values - expected).max() / size)


def _expected(model: ArmModel, trained: Trained, name: str, inputs: Values) -> Values:
    """Return an entry point's outputs by the model in float64, (states, ...), by name."""
    entry = ENTRY_POINTS[name]
    tensors: list[Tensor] = []
    for key in entry.inputs:
        tensor = torch.from_numpy(inputs[key])
        if key != "z":
            tensors.append(tensor)
        elif trained.memory:
            # joint by joint, as the model has it
            tensors.append(tensor.unflatten(-1, (model.n, -1)))
    if name.endswith("_derivatives"):
        function = getattr(model, name.removesuffix("_derivatives"))
        outputs: Sequence[Tensor] = batched_jacobians(function, len(entry.outputs), *tensors)
    elif name == "energy":
        q, qd = tensors
        kinetic = 0.5 * (model.momentum(q, qd) * qd).sum(dim=-1)
        outputs = [torch.stack([kinetic, model.potential_energy(q)], dim=-1)]
    elif name in ("friction_step", "friction_memory"):
        outputs = [tensors[0][:, :0]]
        if trained.memory:
            outputs = [getattr(model, _METHODS[name])(*tensors).flatten(-2)]
    elif name in ("tip_pose", "tip_jacobian"):
        outputs = [getattr(tip_kinematics(trained.arm), name.removeprefix("tip_"))(*tensors)]
    else:
        outputs = [getattr(model, _METHODS.get(name, name))(*tensors)]
    arrays = [output.detach().numpy() for output in outputs]
    return dict(zip(entry.outputs, arrays, strict=True))
