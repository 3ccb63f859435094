"""What no model may break: M positive definite, and energy that falls without input."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from spelgen.evaluation.rollout import rollout
from spelgen.evaluation.tuning import TUNING
from spelgen.logs.windows import Windows

if TYPE_CHECKING:
    from spelgen.emission.loading import EmittedModel


@dataclass(frozen=True)
class Invariants:
    """Of a model that keeps them, the first is positive, the second not.

    least_eigenvalue: of M over 100,000 random q, in units of M's mean eigenvalue there. energy_rise: largest rise of H
    in one of 10,000 steps of 1 ms without input, relative to the largest kinetic energy; None where nothing moves.
    """

    least_eigenvalue: float
    energy_rise: float | None


def invariants(model: EmittedModel, windows: Windows, low: Tensor, high: Tensor) -> Invariants:
    """Measure them over q in low..high (n,), and from the windows' first states."""
    with torch.no_grad():
        return Invariants(_least_eigenvalue(model, low, high), _energy_rise(model, windows))


def _least_eigenvalue(model: EmittedModel, low: Tensor, high: Tensor) -> float:
    """Return that of M over random positions, in units of the mean eigenvalue."""
    generator = torch.Generator().manual_seed(0)
    count = TUNING.sampled_positions
    q = low + (high - low) * torch.rand(count, len(low), dtype=low.dtype, generator=generator)
    chunks = q.chunk(10)  # all at once would take gigabytes
    eigenvalues = torch.cat([torch.linalg.eigvalsh(model.mass_matrix(chunk)) for chunk in chunks])
    return (eigenvalues.min() / eigenvalues.mean().abs()).item()


def _energy_rise(model: EmittedModel, windows: Windows) -> float | None:
    """Return the largest relative rise of H over steps of 1 ms without input."""
    q, qd = windows.q[: TUNING.started_states, 0], windows.qd[: TUNING.started_states, 0]
    no_input = q.new_zeros(len(q), TUNING.free_steps, model.n)
    q, qd = rollout(model, q, qd, no_input, 1e-3)
    q, qd = q[:, 1:], qd[:, 1:]
    energy = model.hamiltonian(q, model.momentum(q, qd))
    kinetic = (energy - model.potential_energy(q)).max().item()
    rise = energy.diff(dim=1).max().item()
    return rise / kinetic if kinetic > 0 and math.isfinite(rise / kinetic) else None
