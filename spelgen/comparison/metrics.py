"""What is measured of one trained model: losses as the paper has them, sizes, speed, and how far M is off."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from pydantic import TypeAdapter, ValidationError

from spelgen.comparison.tuning import TUNING
from spelgen.dynamics.parameters import parameter_count
from spelgen.dynamics.protocol import has_residuals
from spelgen.errors import RunError
from spelgen.evaluation.drawn_motions import PredictedMotion
from spelgen.evaluation.invariants import Invariants
from spelgen.evaluation.plain import finite, record
from spelgen.files import read_json, write_json
from spelgen.fitting.rollout import position_difference, roll_out
from spelgen.logs.trajectory import Trajectory
from spelgen.logs.windows import Windows, cut_windows
from spelgen.pipeline.loaded_arm import load_arm

if TYPE_CHECKING:
    from spelgen.emission.loading import EmittedModel


@dataclass(frozen=True)
class Prediction:
    """Errors of predicted windows, summed over the joints, mean over windows and samples; rad, m and s.

    loss: squared geodesic distance or distance, plus squared velocity error (eq. 8 of the paper). position,
    velocity: its two parts. None: not finite.
    """

    loss: float | None
    position: float | None
    velocity: float | None


@dataclass(frozen=True)
class Sizes:
    """outputs: of the networks of M, D, G and V. inputs: of the network of M."""

    outputs: tuple[int, ...]
    inputs: int
    parameters: int


@dataclass(frozen=True)
class RunResult:
    """The measurements of a trained variant.

    seconds: of training. train, test: errors over windows as long as those of training; prediction: over 1 s of tests.
    mass_error: of M, see `mass_error`. mass: M (T, n, n) at the measured positions of the example.
    """

    variant: str
    seed: int
    seconds: float
    substeps: int
    sizes: Sizes
    train: Prediction
    test: Prediction
    prediction: Prediction
    invariants: Invariants
    mass_error: float
    mass: list[list[list[float]]]
    example: PredictedMotion | None

    def save(self, path: Path) -> None:
        """Write it as JSON."""
        write_json(path, record(self))

    @classmethod
    def read(cls, path: Path) -> RunResult:
        """Read what `save` wrote. Raises RunError."""
        try:
            return TypeAdapter(cls).validate_python(read_json(path, RunError))
        except ValidationError as error:
            raise RunError("other values than a result has", file=path, do="remove it") from error


def thinned(pieces: Sequence[Trajectory], samples: int, decimation: int) -> Windows:
    """At most about so many windows, evenly spread, a multiple of ``decimation`` samples apart."""
    starts = sum(max(0, len(x) - (samples - 1) * decimation) for x in pieces)
    stride = -(-max(1, -(-starts // TUNING.windows)) // decimation) * decimation
    return cut_windows(pieces, samples, stride, decimation, measured=False)


def predict(model: EmittedModel, windows: Windows, substeps: int) -> Prediction:
    """Return the errors of these windows, each predicted from its first sample."""
    with torch.no_grad():
        q, qd = roll_out(model, windows, substeps)
        away = position_difference(q, windows.q[:, 1:], model.joint_types)
        position = away.square().sum(dim=-1).mean()
        velocity = (qd - windows.qd[:, 1:]).square().sum(dim=-1).mean()
    return Prediction(*finite(torch.stack([position + velocity, position, velocity])))


def sizes(model: EmittedModel) -> Sizes:
    """Return how many numbers the model's networks give and read, and how many are trained."""
    energies: Any = model.residuals if has_residuals(model) else model  # beside rigid bodies
    mass, friction = _network(energies, "mass"), _network(model, "friction")
    outputs = []
    for network in (mass, friction, _network(model, "input_network"), _network(energies, "potential")):
        count = 0
        if network is not None:
            # how many depend on q: V that is constant has one output that reads no joint
            last = network.get_buffer(f"mask{len(network.biases) - 1}")
            count = int(last.flatten(1).any(dim=1).sum())
        outputs.append(count)
    if friction is None:
        outputs[1] = model.n  # a function of each joint's own
    inputs = 0 if mass is None else int(mass.mask0.flatten(1).any(dim=0).sum())
    return Sizes(tuple(outputs), inputs, parameter_count(model))


def _network(model: Any, name: str) -> Any:
    """Return the network of a part of the model; None where it has no such part or that has none."""
    owner = getattr(model, name, None)
    return owner if hasattr(owner, "biases") else getattr(owner, "network", None)


def true_mass(robot: Path, q: torch.Tensor) -> torch.Tensor:
    """Return M (T, n, n) [kg m^2, kg m, kg] of a URDF and its sidecar, by Pinocchio, at q (T, n); rotors included."""
    from spelgen.dynamics.pinocchio_arm import arm_dynamics

    loaded = load_arm(robot)
    mass: torch.Tensor = arm_dynamics(loaded.arm, loaded.settings).mass_matrix(q)
    return mass


def mass_error(learned: torch.Tensor, true: torch.Tensor) -> float:
    """Return how far M is off (T, n, n), without unit: root mean square of the entries of L^-1 (learned - true) L^-T.

    L L^T is the mean true M: so every entry counts in the units of its own joints.
    """
    factor = torch.linalg.cholesky(true.mean(dim=0))
    half = torch.linalg.solve_triangular(factor, learned - true, upper=False)
    relative = torch.linalg.solve_triangular(factor, half.mT, upper=False)
    return float(relative.square().mean().sqrt())
