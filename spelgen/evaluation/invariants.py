"""Physical invariants of a model: M is positive definite, and energy does not rise without input."""

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
    from spelgen.emission.assemble import ArmModel


@dataclass(frozen=True)
class Invariants:
    """Measured invariants: the first is positive, the second is not, if the model satisfies them.

    least_eigenvalue: smallest of M over 100,000 random q, divided by the mean eigenvalue. energy_rise: largest rise of
    H in one of 10,000 steps of 1 ms without input, divided by the largest kinetic energy; None without any motion.
    """

    least_eigenvalue: float
    energy_rise: float | None


def invariants(model: ArmModel, windows: Windows, low: Tensor, high: Tensor) -> Invariants:
    """Return the smallest eigenvalue of M over random q in [low, high] (n,), and the largest rise of H in unforced
    rollouts from the first states of the windows.
    """
    with torch.no_grad():
        return Invariants(_least_eigenvalue(model, low, high), _energy_rise(model, windows))


def _least_eigenvalue(model: ArmModel, low: Tensor, high: Tensor) -> float:
    """Return the smallest eigenvalue of M over random q in [low, high] (n,), divided by the mean eigenvalue."""
    generator = torch.Generator().manual_seed(0)
    count = TUNING.sampled_positions
    q = low + (high - low) * torch.rand(count, len(low), dtype=low.dtype, generator=generator)
    chunks = q.chunk(10)  # limits the memory, which would be gigabytes
    eigenvalues = torch.cat([torch.linalg.eigvalsh(model.mass_matrix(chunk)) for chunk in chunks])
    return (eigenvalues.min() / eigenvalues.mean().abs()).item()


def _energy_rise(model: ArmModel, windows: Windows) -> float | None:
    """Return the largest rise of H over steps of 1 ms without input, divided by the largest kinetic energy."""
    q, qd = windows.q[: TUNING.started_states, 0], windows.qd[: TUNING.started_states, 0]
    no_input = q.new_zeros(len(q), TUNING.free_steps, model.n)
    q, qd = rollout(model, q, qd, no_input, 1e-3)
    q, qd = q[:, 1:], qd[:, 1:]
    energy = model.hamiltonian(q, model.momentum(q, qd))
    kinetic = (energy - model.potential_energy(q)).max().item()
    rise = energy.diff(dim=1).max().item()
    return rise / kinetic if kinetic > 0 and math.isfinite(rise / kinetic) else None
