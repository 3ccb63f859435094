"""What is measured of one trained model: losses as the paper has them, sizes, speed, and the laws it must keep."""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

from spelgen.evaluation.invariants import energy_drift
from spelgen.fitting.rollout import LossScales, position_difference, roll_out, rollout_loss
from spelgen.logs.read import Trajectory
from spelgen.logs.windows import Windows, cut_windows

if TYPE_CHECKING:
    from spelgen.fitting.run_folder import EmittedModel

MOST_WINDOWS = 512
POSITIONS = 100_000
FREE_STEPS, FREE_STEP = 10_000, 1e-3  # s
FREE_STATES = 8
TIMED_STEPS = 9


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
class Laws:
    """What no trained model may break.

    least_eigenvalue: of M over 100,000 random q, in units of M's mean eigenvalue there. orthogonality:
    largest |R R^T - I| after 10,000 steps without input. energy_rise: largest rise of H in a step of these,
    relative to the largest kinetic energy. drift: of H without dissipation, likewise, over 1 s.
    """

    least_eigenvalue: float
    orthogonality: float
    energy_rise: float | None
    drift: float | None


@dataclass(frozen=True)
class Sizes:
    """outputs: of the networks of M, D, G and V. inputs: of the network of M."""

    outputs: tuple[int, int, int, int]
    inputs: int
    parameters: int


def thinned(pieces: Sequence[Trajectory], samples: int, every: int) -> Windows:
    """At most about ``MOST_WINDOWS`` windows, evenly spread, a multiple of ``every`` samples apart."""
    starts = sum(max(0, len(x.t) - (samples - 1) * every) for x in pieces)
    stride = -(-max(1, -(-starts // MOST_WINDOWS)) // every) * every
    return cut_windows(pieces, samples, stride, every, measured=False)


def predict(model: EmittedModel, windows: Windows, substeps: int) -> Prediction:
    """The errors of these windows, each predicted from its first sample."""
    with torch.no_grad():
        q, qd = roll_out(model, windows, substeps)
        away = position_difference(q, windows.q[:, 1:], model.joint_types)
        position = away.square().sum(dim=-1).mean().item()
        velocity = (qd - windows.qd[:, 1:]).square().sum(dim=-1).mean().item()
    values = (position + velocity, position, velocity)
    return Prediction(*(x if math.isfinite(x) else None for x in values))


def laws(model: EmittedModel, windows: Windows, low: torch.Tensor, high: torch.Tensor) -> Laws:
    """Whether the model keeps the laws: over q in low..high (n,), and from the windows' first states."""
    generator = torch.Generator().manual_seed(0)
    q = low + (high - low) * torch.rand(POSITIONS, len(low), dtype=low.dtype, generator=generator)
    least, mean = math.inf, 0.0
    with torch.no_grad():
        for part in q.split(POSITIONS // 10):
            values = torch.linalg.eigvalsh(model.mass_matrix(part))
            least, mean = min(least, values.min().item()), mean + values.mean().item() / 10
        orthogonality, rise = _free_motion(model, windows)
    return Laws(least / abs(mean), orthogonality, rise, energy_drift(model, windows))


def _free_motion(model: EmittedModel, windows: Windows) -> tuple[float, float | None]:
    """|R R^T - I| and the largest relative rise of H over 10,000 steps of 1 ms without input."""
    q, qd = windows.q[:FREE_STATES, 0], windows.qd[:FREE_STATES, 0]
    states, n = len(q), model.n
    free = Windows(
        torch.full((states, FREE_STEPS), FREE_STEP, dtype=q.dtype),
        q.unsqueeze(1).expand(states, FREE_STEPS + 1, n),
        qd.unsqueeze(1).expand(states, FREE_STEPS + 1, n),
        torch.zeros(states, FREE_STEPS, n, dtype=q.dtype),
    )
    q, qd = roll_out(model, free, 1)
    worst = 0.0
    for part, kind in zip(model.to_group(q[:, -1]), model.joint_types, strict=True):
        if kind == "revolute":
            worst = max(worst, (part @ part.mT - torch.eye(3, dtype=q.dtype)).abs().max().item())
    energy = model.hamiltonian(q, model.momentum(q, qd))
    moved = (energy - model.potential_energy(q)).max().item()
    rise = energy.diff(dim=1).max().item() / moved if moved > 0 else math.nan
    return worst, rise if math.isfinite(rise) else None


def sizes(model: EmittedModel) -> Sizes:
    """How many numbers the model's networks give and read, and how many are trained."""

    def outputs(network: object) -> int:
        return len(network.biases[-1]) if hasattr(network, "biases") else 0

    mass = getattr(model, "mass_network", None)
    friction = getattr(model.friction, "network", None)
    return Sizes(
        (
            outputs(mass),
            outputs(friction) if friction is not None else model.n,
            outputs(getattr(model, "input_network", None)),
            outputs(getattr(model, "potential_network", None)),
        ),
        0 if mass is None else int(mass.weights[0].shape[1]),
        sum(parameter.numel() for parameter in model.parameters()),
    )


def step_seconds(model: EmittedModel, windows: Windows, scales: LossScales, substeps: int) -> float:
    """Median time of a training step on these windows, without the update of the weights [s]."""
    times = []
    for _ in range(TIMED_STEPS):
        start = time.perf_counter()
        model.zero_grad()
        rollout_loss(model, windows, scales, substeps).backward()
        times.append(time.perf_counter() - start)
    return statistics.median(times)
