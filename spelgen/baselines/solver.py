"""The solver of windows, in steps that are accurate for the dynamics at hand."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from spelgen.baselines.rosenbrock import roll_out_stiff
from spelgen.dynamics.protocol import RigidDynamics
from spelgen.logs.windows import Windows, thinned
from spelgen.settings.tuning.evaluation import EvaluationTuning

TUNING = EvaluationTuning()
States = tuple[Tensor, Tensor]


@dataclass(frozen=True)
class Solver:
    """Predict windows, by so many steps of the Rosenbrock method between samples."""

    dynamics: RigidDynamics
    substeps: int

    def __call__(self, windows: Windows, disturbance: Tensor | None = None) -> States:
        """Return q and qd, (W, K-1, n); under a disturbance (W, n). What leaves all bounds is NaN."""
        with torch.no_grad(), np.errstate(over="ignore", invalid="ignore"):
            return roll_out_stiff(self.dynamics, windows, self.substeps, disturbance)


def accurate_solver(dynamics: RigidDynamics, probe: Windows) -> Solver:
    """Return the solver with the fewest steps between samples that twice as many agree with on the probe."""
    windows = thinned(probe, TUNING.probed_windows)
    motion = (windows.qd - windows.qd[:, :1]).square().mean().sqrt().clamp(min=1e-9)
    solver = Solver(dynamics, 1)
    coarse = solver(windows)[1]
    # shorter steps are for dynamics that leave all bounds, which are not worth them
    while (
        2 * solver.substeps <= TUNING.most_substeps
        and windows.dt.mean() / (2 * solver.substeps) >= TUNING.shortest_step
    ):
        finer = replace(solver, substeps=2 * solver.substeps)
        fine = finer(windows)[1]
        error = (fine - windows.qd[:, 1:]).square().mean().sqrt()
        if (fine - coarse).square().mean().sqrt() < TUNING.tolerance * torch.maximum(
            TUNING.least_error * motion, error
        ):
            break
        solver, coarse = finer, fine
    return solver
