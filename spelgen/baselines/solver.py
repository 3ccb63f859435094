"""Solvers of windows, accurate for dynamics whatever steps the model beside them needs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from spelgen.baselines.rosenbrock import roll_out_stiff
from spelgen.dynamics.protocol import RigidDynamics, VelocityState, integrable
from spelgen.fitting.rollout import roll_out
from spelgen.logs.windows import Windows, thinned
from spelgen.settings.tuning.evaluation import EvaluationTuning

TUNING = EvaluationTuning()
States = tuple[Tensor, Tensor]


class Disturbed:
    """Add a disturbance (W, n) to the p' of what a rollout integrates; all else is as it was."""

    def __init__(self, form: Any, disturbance: Tensor) -> None:
        self.form, self.disturbance = form, disturbance

    def __getattr__(self, name: str) -> object:
        return getattr(self.form, name)

    def port_hamiltonian_rhs(
        self, q: Tensor, p: Tensor, tau: Tensor, prepared: object, *state: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """Return q' and p', (W, n)."""
        qd, force = self.form.port_hamiltonian_rhs(q, p, tau, prepared, *state)
        return qd, force + self.disturbance


@dataclass(frozen=True)
class Solver:
    """Predict windows. form: what is integrated, see `integrable`. method: `roll_out` or `roll_out_stiff`."""

    form: Any  # PortHamiltonianDynamics or a VelocityState
    method: Callable[[Any, Windows, int], States]
    substeps: int

    def __call__(self, windows: Windows, disturbance: Tensor | None = None) -> States:
        """Return q and qd, (W, K-1, n); under a disturbance (W, n) that is added to p'.

        Leaving all bounds is no error: where numbers blow up they are NaN, for few windows beside those to blame.
        """
        try:
            return self._roll_out(windows, disturbance)
        except torch.linalg.LinAlgError:
            # LAPACK says that some matrix of the batch failed, not which; window by window would take minutes
            parts = torch.arange(len(windows)).tensor_split(min(len(windows), TUNING.parts_of_windows))
        positions, velocities = [], []
        for rows in parts:
            part = windows[rows]
            try:
                q, qd = self._roll_out(part, None if disturbance is None else disturbance[rows])
            except torch.linalg.LinAlgError:
                q = qd = torch.full_like(part.q[:, 1:], torch.nan)
            positions.append(q)
            velocities.append(qd)
        return torch.cat(positions), torch.cat(velocities)

    def _roll_out(self, windows: Windows, disturbance: Tensor | None) -> States:
        form = self.form
        if disturbance is not None:
            form = Disturbed(form, disturbance)
        with torch.no_grad(), np.errstate(over="ignore", invalid="ignore"):
            return self.method(form, windows, self.substeps)


def accurate_solver(dynamics: RigidDynamics, probe: Windows) -> Solver:
    """Return a solver that is accurate on the probe: RK4 where some steps between samples are enough, and where none
    are the Rosenbrock method.
    """
    explicit = Solver(integrable(dynamics), roll_out, 1)
    implicit = Solver(VelocityState(dynamics), roll_out_stiff, 1)
    windows = thinned(probe, TUNING.probed_windows)
    # each doubling is tried against the next: powers of two waste no rollout
    most = 1
    while 2 * most <= TUNING.most_substeps and probe.dt.mean() / (2 * most) >= TUNING.shortest_step:
        most *= 2
    for solver, tolerance in (
        (explicit, TUNING.explicit_tolerance),
        (implicit, TUNING.implicit_tolerance),
    ):
        accurate = _with_enough_steps(solver, windows, tolerance, most)
        if accurate is not None:
            return accurate
    # dynamics that leave all bounds are not worth smaller steps
    return replace(implicit, substeps=most)


def _with_enough_steps(solver: Solver, probe: Windows, tolerance: float, most: int) -> Solver | None:
    """Return the solver with the fewest steps between samples that twice as many agree with."""
    # errors below a tenth of the motion are accurate enough for any comparison
    motion = (probe.qd - probe.qd[:, :1]).square().mean().sqrt().clamp(min=1e-9)
    coarse = solver(probe)[1]
    while solver.substeps <= most:
        finer = replace(solver, substeps=2 * solver.substeps)
        fine = finer(probe)[1]
        error = (fine - probe.qd[:, 1:]).square().mean().sqrt()
        if (fine - coarse).square().mean().sqrt() < tolerance * torch.maximum(0.1 * motion, error):
            return solver
        solver, coarse = finer, fine
    return None
