"""A predictor of an arm's motion: a model, a baseline or any other dynamics, with a method that integrates it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from spelgen.baselines.rosenbrock import roll_out_stiff
from spelgen.baselines.tuning import TUNING
from spelgen.dynamics.protocol import RigidDynamics
from spelgen.logs.windows import Windows, thinned

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


@dataclass(frozen=True)
class Predictor:
    """Predict windows of K samples: q and qd, both (W, K-1, n), from the first sample and the inputs.

    solver: what does so; a `Solver` of the dynamics, where there are any. dynamics: None where a prediction needs none.
    """

    name: str
    solver: Callable[[Windows], States]
    dynamics: RigidDynamics | None = None


def of_dynamics(name: str, dynamics: RigidDynamics, probe: Windows) -> Predictor:
    """Return dynamics as a predictor, by as many steps as they themselves need on the probe."""
    return Predictor(name, accurate_solver(dynamics, probe), dynamics)
