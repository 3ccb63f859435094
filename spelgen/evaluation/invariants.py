"""How well an undamped model keeps its energy, integrated to thirteen digits: what is left is the model's own."""

from __future__ import annotations

import math
import warnings
from typing import TYPE_CHECKING, Any

import torch
from torchdiffeq import odeint

from spelgen.logs.windows import Windows

if TYPE_CHECKING:
    from spelgen.fitting.run_folder import EmittedModel

DRIFT_SECONDS, DRIFT_TIMES = 1.0, 101
DRIFT_SOLVER: dict[str, Any] = {"rtol": 1e-13, "atol": 1e-15, "options": {"solver": "DOP853"}}
DRIFT_STATES, DRIFT_CALLS = 8, 30_000


class _TooStiff(Exception):
    """An integrator's steps have become too many."""


def energy_drift(model: EmittedModel, windows: Windows) -> float | None:
    """Largest |H(t) - H(0)| over 1 s without input and dissipation, relative to the largest kinetic energy
    met.

    From the windows' fastest states, integrated to thirteen digits, so that what is left is the model's own.
    None where that cannot be done.
    """
    q, qd = windows.q[:, 0], windows.qd[:, 0]
    prepared = model.prepare()
    p = model.momentum(q, qd, prepared)
    kinetic = model.hamiltonian(q, p) - model.potential_energy(q)
    fastest = kinetic.topk(min(DRIFT_STATES, len(windows))).indices
    start = torch.cat([q[fastest], p[fastest]], dim=-1)

    calls = 0

    def undamped(t: torch.Tensor, state: torch.Tensor) -> torch.Tensor:
        nonlocal calls
        calls += 1
        if calls > DRIFT_CALLS:
            raise _TooStiff
        q, p = state.chunk(2, dim=-1)
        qd, force = model.rates(q, p, None, prepared)
        friction = (model.dissipation(q, qd) @ qd.unsqueeze(-1)).squeeze(-1)
        return torch.cat([qd, force + friction], dim=-1)

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
