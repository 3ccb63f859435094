"""Fit position servos, friction and weight of an arm to logs of commanded positions: its most probable weights.

First least squares on the command error (`servo_start`), then predicted windows (`servo_descent`), in rounds: each
takes the bodies' load along what has been predicted, and the scale of errors, anew. Before the fine ones dead zones
enter, where windows ask for them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from spelgen.dynamics.bristles import encoder_step
from spelgen.fitting.servo_dead_zones import dead_zones
from spelgen.fitting.servo_descent import Descent, Normal
from spelgen.fitting.servo_problem import ServoProblem
from spelgen.fitting.servo_start import start_servos
from spelgen.fitting.servo_weights import DEAD_ZONE, Point
from spelgen.fitting.servo_windows import ServoWindows
from spelgen.logs.trajectory import Trajectory

ROUNDS = 5
FINE = 2  # rounds at the end with all steps between samples, the others with half of them
GAIN = (
    1.0,
    0.05,
)  # of the cost, in rounds before the fine ones, and in these: a step that gains less ends a round
DAMPING = (1e-2, 1e-5)  # to begin with, in the first round and in the others


@dataclass(frozen=True, eq=False)
class ServoSolution:
    """How a fit ended. rms: (n,) root mean square errors of positions over windows [rad, m]. names: of the rows of
    weights of joints, (p, n), which with directions of bodies and the delay are the k unknowns of `Point.flat`.
    normal: of windows there; precision: (k,) of the prior, of all dead zones too; halved: (k,) what half as long steps
    of the rollouts still changed at the end. gravity: (n,) mean size of its torque along the windows.
    """

    names: tuple[tuple[str, int], ...]
    rms: torch.Tensor
    steps: int
    cost: float
    normal: Normal
    precision: torch.Tensor
    halved: torch.Tensor
    gravity: torch.Tensor


def fit_servos(model: Any, windows: ServoWindows, logs: Sequence[Trajectory]) -> ServoSolution:
    """Give the model the most probable weights."""
    delay = 1 / windows.rate
    model.servo.delay.fill_(delay)
    start_servos(model, windows, ServoProblem(model, windows).load, delay)
    noise = torch.from_numpy(np.max([encoder_step(x.q) for x in logs], axis=0)).clamp(min=1e-5) / 12**0.5
    problem = ServoProblem(model, replace(windows, steps=-(-windows.steps // 2)))
    descent = Descent(problem, noise, problem.errors(problem.start))
    point, cost, steps = descent.run(problem.start, DAMPING[0], GAIN[0])
    for turn in range(1, ROUNDS):
        if turn == ROUNDS - FINE:
            point = _with_dead_zones(descent, point)
            problem.windows = windows
        problem.relinearise(point, problem.path(point))
        descent = Descent(problem, noise, problem.errors(point))
        point, cost, taken = descent.run(point, DAMPING[1], GAIN[turn >= ROUNDS - FINE])
        steps += taken
    problem.windows = replace(windows, steps=2 * windows.steps)
    normal = descent.normal(point, problem.errors(point))
    halved = descent.step(normal, point)
    point = point.moved(halved)
    problem.write(point)
    errors = problem.errors(point)
    return ServoSolution(
        names=tuple(problem.weights.names),
        rms=errors.square().mean(dim=(0, 1)).sqrt(),
        steps=steps,
        cost=cost,
        normal=normal,
        precision=problem.weights.precision(len(point.bodies), every=True),
        halved=halved,
        gravity=problem.load.gravity.abs().mean(dim=(0, 1)),
    )


def _with_dead_zones(descent: Descent, point: Point) -> Point:
    """The point, with those that windows ask for, which are fitted from now on."""
    problem, weights = descent.problem, descent.problem.weights
    row, n = weights.row(DEAD_ZONE), problem.model.n
    precision = weights.precision(len(point.bodies), every=True)
    normal = descent.normal(point, problem.errors(point))
    places = torch.arange(n) + row * n
    widths = dead_zones(normal, point.flat - descent.centre, precision, places)
    weights.dead_zones = widths > 0
    joints = point.joints.clone()
    joints[row] = widths
    return replace(point, joints=joints)
