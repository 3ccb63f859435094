"""Predictors of the motion of an arm, under torques or under position commands: a model, or a baseline."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from spelgen.baselines.rosenbrock import roll_out_stiff
from spelgen.baselines.tuning import TUNING
from spelgen.dynamics.protocol import RigidDynamics
from spelgen.logs.commands import LogRows
from spelgen.logs.windows import Windows, thinned

States = tuple[Tensor, Tensor]


@dataclass(frozen=True)
class Solver:
    """The Rosenbrock method, with `substeps` steps per sample interval."""

    dynamics: RigidDynamics
    substeps: int

    def __call__(self, windows: Windows, disturbance: Tensor | None = None) -> States:
        """Return predicted q and qd, (W, K-1, n); NaN if they diverged. disturbance: see `roll_out_stiff`."""
        with torch.no_grad(), np.errstate(over="ignore", invalid="ignore"):
            return roll_out_stiff(self.dynamics, windows, self.substeps, disturbance)


def accurate_solver(dynamics: RigidDynamics, probe: Windows) -> Solver:
    """Return the solver with the fewest steps per sample interval whose result twice as many steps confirm."""
    windows = thinned(probe, TUNING.probed_windows)
    motion = (windows.qd - windows.qd[:, :1]).square().mean().sqrt().clamp(min=1e-9)
    solver = Solver(dynamics, 1)
    coarse = solver(windows)[1]
    # only dynamics that diverge would need shorter steps, and cannot be predicted with them either
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
    """A predictor of windows of K samples: q and qd, both (W, K-1, n), from the first sample and the torques.

    solver: a `Solver` if there are dynamics, else any function. dynamics: None if the prediction needs none.
    """

    name: str
    solver: Callable[[Windows], States]
    dynamics: RigidDynamics | None = None


def of_dynamics(name: str, dynamics: RigidDynamics, probe: Windows) -> Predictor:
    """Return the predictor of some dynamics, with the steps that these need on the probe."""
    return Predictor(name, accurate_solver(dynamics, probe), dynamics)


class CommandFollower(Protocol):
    """Predictor of positions under position commands. about: what it is, and how it was fitted."""

    @property
    def about(self) -> str: ...

    def positions(self, parts: Sequence[LogRows], q: np.ndarray, qd: np.ndarray) -> list[np.ndarray]:
        """Return the positions at the end of each sample interval.

        Args:
            parts: rows of logs, each with K sample intervals.
            q: (parts, n) initial positions [rad, m].
            qd: (parts, n) initial velocities [rad/s, m/s].

        Returns:
            (K, n) [rad, m] for each part.
        """
