"""What no model may break: M positive definite, rotations, energy that falls without input and else stays."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch
from torchdiffeq import odeint

from spelgen.evaluation.rollout import rollout
from spelgen.logs.windows import Windows

if TYPE_CHECKING:
    from spelgen.emission.loading import EmittedModel

DRIFT_SECONDS, DRIFT_TIMES = 1.0, 101
DRIFT_SOLVER: dict[str, Any] = {"rtol": 1e-13, "atol": 1e-15, "options": {"solver": "DOP853"}}
DRIFT_CALLS = 30_000
POSITIONS = 100_000
FREE_STEPS, FREE_STEP = 10_000, 1e-3  # s
STATES = 8  # to start from


@dataclass(frozen=True)
class Invariants:
    """Of a model that keeps them, the first is positive, the second rounding, the third not positive.

    least_eigenvalue: of M over 100,000 random q, in units of M's mean eigenvalue there. orthogonality: largest
    |R R^T - I| after 10,000 steps of 1 ms without input. energy_rise: largest rise of H in a step of these,
    relative to the largest kinetic energy. energy_drift: of H without dissipation, likewise, over 1 s.
    """

    least_eigenvalue: float
    orthogonality: float
    energy_rise: float | None
    energy_drift: float | None


def invariants(model: EmittedModel, windows: Windows, low: torch.Tensor, high: torch.Tensor) -> Invariants:
    """What the model keeps: over q in low..high (n,), and from the windows' first states."""
    generator = torch.Generator().manual_seed(0)
    q = low + (high - low) * torch.rand(POSITIONS, len(low), dtype=low.dtype, generator=generator)
    least, mean = math.inf, 0.0
    with torch.no_grad():
        for part in q.split(POSITIONS // 10):
            values = torch.linalg.eigvalsh(model.mass_matrix(part))
            least, mean = min(least, values.min().item()), mean + values.mean().item() / 10
        orthogonality, rise = _free_motion(model, windows)
    return Invariants(least / abs(mean), orthogonality, rise, energy_drift(model, windows))


def _free_motion(model: EmittedModel, windows: Windows) -> tuple[float, float | None]:
    """|R R^T - I| and the largest relative rise of H over 10,000 steps of 1 ms without input."""
    q, qd = windows.q[:STATES, 0], windows.qd[:STATES, 0]
    q, qd = rollout(model, q, qd, q.new_zeros(len(q), FREE_STEPS, model.n), FREE_STEP)
    q, qd = q[:, 1:], qd[:, 1:]
    worst = 0.0
    for part, kind in zip(model.to_group(q[:, -1]), model.joint_types, strict=True):
        if kind == "revolute":
            worst = max(worst, (part @ part.mT - torch.eye(3, dtype=q.dtype)).abs().max().item())
    energy = model.hamiltonian(q, model.momentum(q, qd))
    moved = (energy - model.potential_energy(q)).max().item()
    rise = energy.diff(dim=1).max().item() / moved if moved > 0 else math.nan
    return worst, rise if math.isfinite(rise) else None


class _TooStiff(Exception):
    """An integrator's steps have become too many."""


def energy_drift(model: EmittedModel, windows: Windows) -> float | None:
    """Largest |H(t) - H(0)| over 1 s without input and dissipation, relative to the largest kinetic energy.

    From the windows' fastest states, integrated to thirteen digits, so that what is left is the model's own.
    None where that cannot be done.
    """
    q, qd = windows.q[:, 0], windows.qd[:, 0]
    prepared = model.prepare()
    p = model.momentum(q, qd, prepared)
    kinetic = model.hamiltonian(q, p) - model.potential_energy(q)
    fastest = kinetic.topk(min(STATES, len(windows))).indices
    start = torch.cat([q[fastest], p[fastest]], dim=-1)

    calls = 0

    def undamped(t: torch.Tensor, state: torch.Tensor) -> torch.Tensor:
        nonlocal calls
        calls += 1
        if calls > DRIFT_CALLS:
            raise _TooStiff
        q, p = state.chunk(2, dim=-1)
        at = model.configuration(q, prepared)
        mass, residuals = model.mass_at(at, prepared)
        qd = torch.linalg.solve(mass, p)
        return torch.cat([qd, model.lagrangian_gradient(at, qd, residuals, prepared)], dim=-1)

    times = torch.linspace(0.0, DRIFT_SECONDS, DRIFT_TIMES, dtype=q.dtype)
    with torch.no_grad(), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # torchdiffeq hands SciPy an option that has no effect
        try:
            # SciPy's Dormand-Prince of order 8: torchdiffeq's own keeps to eight digits only
            states = odeint(undamped, start, times, method="scipy_solver", **DRIFT_SOLVER)
        except _TooStiff:
            return None
        q, p = states.chunk(2, dim=-1)
        energy = model.hamiltonian(q, p)
        moved = (energy - model.potential_energy(q)).max().item()
        drift = (energy - energy[0]).abs().max().item() / moved if moved > 0 else math.nan
    return drift if math.isfinite(drift) else None
