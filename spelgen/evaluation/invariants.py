"""What no model may break: M positive definite, energy that falls without input and else stays."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor
from torchdiffeq import odeint

from spelgen.evaluation.rollout import rollout
from spelgen.logs.windows import Windows
from spelgen.settings.tuning.evaluation import EvaluationTuning

if TYPE_CHECKING:
    from spelgen.emission.loading import EmittedModel

TUNING = EvaluationTuning()


@dataclass(frozen=True)
class Invariants:
    """Of a model that keeps them, the first is positive, the second not.

    least_eigenvalue: of M over 100,000 random q, in units of M's mean eigenvalue there. energy_rise: largest rise of H
    in one of 10,000 steps of 1 ms without input, relative to the largest kinetic energy. energy_drift: of H without
    dissipation, likewise, over 1 s.
    """

    least_eigenvalue: float
    energy_rise: float | None
    energy_drift: float | None


def invariants(model: EmittedModel, windows: Windows, low: Tensor, high: Tensor) -> Invariants:
    """Measure them over q in low..high (n,), and from the windows' first states."""
    with torch.no_grad():
        rise = _energy_rise(model, windows)
        smallest = _least_eigenvalue(model, low, high)
    return Invariants(smallest, rise, energy_drift(model, windows))


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
    return _ratio(energy.diff(dim=1).max().item(), kinetic)


class _TooStiff(Exception):
    """An integrator's steps have become too many."""


class _Undamped:
    """The equations of motion without input and dissipation, of states (q, p) side by side."""

    def __init__(self, model: EmittedModel) -> None:
        self._model, self._cache = model, model.prepare()
        self._calls = 0

    def __call__(self, t: Tensor, state: Tensor) -> Tensor:
        self._calls += 1
        if self._calls > TUNING.drift_calls:
            raise _TooStiff
        model = self._model
        q, p = state.chunk(2, dim=-1)
        pose = model.configuration(q, self._cache)
        qd = torch.linalg.solve(pose.mass, p)
        return torch.cat([qd, model.lagrangian_gradient(pose, qd)], dim=-1)


def energy_drift(model: EmittedModel, windows: Windows) -> float | None:
    """Return the largest |H(t) - H(0)| over 1 s without input and dissipation, relative to the largest kinetic energy.

    From the windows' fastest states, integrated to thirteen digits, so that what is left is the model's own.
    None where that cannot be done.
    """
    q, qd = windows.q[:, 0], windows.qd[:, 0]
    times = torch.linspace(0.0, 1.0, 101, dtype=q.dtype)
    with torch.no_grad(), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # torchdiffeq hands SciPy an option that has no effect
        p = model.momentum(q, qd)
        kinetic = model.hamiltonian(q, p) - model.potential_energy(q)
        fastest = kinetic.topk(min(TUNING.started_states, len(windows))).indices
        start = torch.cat([q[fastest], p[fastest]], dim=-1)
        try:
            # SciPy's Dormand-Prince of order 8: torchdiffeq's own keeps to eight digits only
            states = odeint(
                _Undamped(model), start, times, rtol=1e-13, atol=1e-15, method="scipy_solver",
                options={"solver": "DOP853"},
            )  # fmt: skip
        except _TooStiff:
            return None
        q, p = states.chunk(2, dim=-1)
        energy = model.hamiltonian(q, p)
        kinetic = energy - model.potential_energy(q)
    return _ratio((energy - energy[0]).abs().max().item(), kinetic.max().item())


def _ratio(change: float, kinetic: float) -> float | None:
    """Return a change of energy relative to the kinetic one; None where nothing moves."""
    ratio = change / kinetic if kinetic > 0 else math.nan
    return ratio if math.isfinite(ratio) else None
