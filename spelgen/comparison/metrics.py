"""What is measured of one trained model: losses as the paper has them, sizes, speed."""

from __future__ import annotations

import statistics
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch

from spelgen.dynamics.protocol import has_residuals
from spelgen.evaluation.plain import finite
from spelgen.fitting.rollout import LossScales, position_difference, roll_out, rollout_loss
from spelgen.logs.trajectory import Trajectory
from spelgen.logs.windows import Windows, cut_windows
from spelgen.settings.tuning.comparison import ComparisonTuning

if TYPE_CHECKING:
    from spelgen.emission.loading import EmittedModel

TUNING = ComparisonTuning()


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

    outputs: tuple[int, int, int, int]
    inputs: int
    parameters: int


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
    mass = _network(energies, "mass")
    networks = (
        mass, _network(model, "friction"), _network(model, "input_network"), _network(energies, "potential")
    )  # fmt: skip
    outputs = []
    for network in networks:
        outputs.append(0 if network is None else len(network.biases[-1]))
    if _network(model, "friction") is None:
        outputs[1] = model.n  # a function of each joint's own
    inputs = 0 if mass is None else int(mass.weights[0].shape[1])
    parameters = sum(parameter.numel() for parameter in model.parameters())
    return Sizes((outputs[0], outputs[1], outputs[2], outputs[3]), inputs, parameters)


def _network(model: Any, name: str) -> Any:
    """Return the network of a part of the model; None where it has no such part or that has none."""
    owner = getattr(model, name, None)
    return owner if hasattr(owner, "biases") else getattr(owner, "network", None)


def step_seconds(model: EmittedModel, windows: Windows, scales: LossScales, substeps: int) -> float:
    """Return the median time of a training step on these windows, without the update of the weights [s]."""
    times = []
    # the median: other programs run beside
    for _ in range(TUNING.timed_steps):
        start = time.perf_counter()
        model.zero_grad()
        torch.autograd.backward(rollout_loss(model, windows, scales, substeps))
        times.append(time.perf_counter() - start)
    return statistics.median(times)
