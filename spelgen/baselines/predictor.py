"""A predictor of an arm's motion: a model, a baseline or any other dynamics, with a method that integrates it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from spelgen.baselines.solver import States, accurate_solver
from spelgen.dynamics.protocol import RigidDynamics
from spelgen.logs.windows import Windows


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
