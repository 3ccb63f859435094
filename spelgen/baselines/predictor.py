"""A predictor of an arm's motion: a model, a baseline or any other dynamics, with a method that integrates it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from spelgen.baselines.solver import Solver, States, accurate_solver
from spelgen.dynamics.protocol import RigidDynamics, integrable
from spelgen.fitting.rollout import roll_out
from spelgen.logs.windows import Windows


@dataclass(frozen=True)
class Predictor:
    """Predict windows of K samples: q and qd, both (W, K-1, n), from the first sample and the inputs.

    solver: what does so; a `Solver` of the dynamics, where there are any. dynamics: None where a prediction needs none.
    """

    name: str
    solver: Callable[[Windows], States]
    dynamics: RigidDynamics | None = None


def of_dynamics(name: str, dynamics: RigidDynamics, substeps: int) -> Predictor:
    """Return dynamics as a predictor, by so many steps of the classical Runge-Kutta method between samples."""
    return Predictor(name, Solver(integrable(dynamics), roll_out, substeps), dynamics)


def of_accurate_dynamics(name: str, dynamics: RigidDynamics, probe: Windows) -> Predictor:
    """Return dynamics as a predictor, by the method and the steps that they themselves need on the probe."""
    return Predictor(name, accurate_solver(dynamics, probe), dynamics)
