"""Fit position servos, friction and weight of an arm to logs of commanded positions: its most probable weights.

First least squares on the command error (`servo_start`), then predicted windows, by Levenberg-Marquardt steps on

    sum over joints and samples of 4 log(1 + (error / scale)^2 / 4) / alike + |(weights - start) / deviation|^2,

Student's t with three degrees of freedom: a joint that is held by something unknown, a table maybe, counts little.
The scale of a joint is what its errors usually are, found in rounds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from spelgen.dynamics.bristles import encoder_step
from spelgen.fitting.servo_problem import Point, ServoProblem
from spelgen.fitting.servo_start import start_servos
from spelgen.fitting.servo_windows import ServoWindows
from spelgen.logs.trajectory import Trajectory

ALIKE = 0.5  # s over which errors are alike and count once
ROUNDS, STEPS, TRIES = 3, 10, 6
LONGEST = 1.0  # of a step, in any weight: they are logarithms
GAIN = 2e-3  # relative: a step that gains less ends a round


@dataclass(frozen=True, eq=False)
class ServoSolution:
    """How a fit ended. rms: (n,) root mean square errors of positions over windows [rad, m]; covariance (k, k): of the
    weights of joints (p, n), of directions of bodies and of the delay, in the order of `Point.flat`. gravity: (n,)
    mean size of its torque along the windows.
    """

    names: tuple[tuple[str, int], ...]
    rms: torch.Tensor
    steps: int
    cost: float
    covariance: torch.Tensor
    gravity: torch.Tensor


def fit_servos(model: Any, windows: ServoWindows, logs: Sequence[Trajectory]) -> ServoSolution:
    """Give the model the most probable weights."""
    delay = 1 / windows.rate
    model.servo.delay.fill_(delay)
    start_servos(model, windows, ServoProblem(model, windows).load, delay)
    problem = ServoProblem(model, windows)
    noise = torch.from_numpy(np.max([encoder_step(x.q) for x in logs], axis=0)).clamp(min=1e-5)
    prior = problem.relinearise()
    centre = prior.flat
    steps, point = 0, prior
    for turn in range(ROUNDS):
        descent = _Descent(problem, centre, noise, problem.errors(point))
        point, cost, taken = descent.run(point)
        steps += taken
        problem.write(point)
        if turn < ROUNDS - 1:
            point = problem.relinearise()
    errors = problem.errors(point)
    return ServoSolution(
        tuple(problem.names), errors.square().mean(dim=0).sqrt(), steps, cost,
        torch.linalg.inv(descent.curvature(point, errors)[0]), problem.load.gravity.abs().mean(dim=(0, 1)),
    )  # fmt: skip


class _Descent:
    """Steps with one scale of errors (n,)."""

    def __init__(
        self, problem: ServoProblem, centre: torch.Tensor, noise: torch.Tensor, errors: torch.Tensor
    ) -> None:
        self.problem, self.centre = problem, centre
        self.precision = problem.deviations() ** -2
        self.alike = max(1.0, ALIKE * problem.windows.rate)
        self.scale = torch.maximum(1.4826 * errors.abs().median(dim=0).values, noise)

    def cost(self, point: Point, errors: torch.Tensor) -> float:
        if not errors.isfinite().all():
            return float("inf")
        squares = (errors / self.scale).square()
        away = point.flat - self.centre
        return float(
            (4 * torch.log1p(squares / 4)).sum() / self.alike + (self.precision * away.square()).sum()
        )

    def curvature(self, point: Point, errors: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Of the cost, half its second and first derivatives, by Gauss and Newton."""
        own, shared = self.problem.slopes(point, errors)
        weight = 1 / (1 + (errors / self.scale).square() / 4) / self.scale**2 / self.alike
        p, n, s = len(own), errors.shape[1], len(shared)
        matrix, target = torch.zeros(p * n + s, p * n + s).double(), torch.zeros(p * n + s).double()
        for k in range(n):
            slope = torch.cat([own[..., k], shared[..., k]])
            rows = torch.cat([torch.arange(p) * n + k, p * n + torch.arange(s)])
            weighted = slope * weight[:, k]
            matrix[rows[:, None], rows] += weighted @ slope.mT
            target[rows] += weighted @ errors[:, k]
        away = point.flat - self.centre
        return matrix + torch.diag(self.precision), target + self.precision * away

    def run(self, point: Point) -> tuple[Point, float, int]:
        errors = self.problem.errors(point)
        cost, damping, taken = self.cost(point, errors), 1e-2, 0
        for _ in range(STEPS):
            matrix, target = self.curvature(point, errors)
            for _ in range(TRIES):
                damped = matrix + damping * torch.diag(matrix.diagonal())
                tried = point.moved(-torch.linalg.solve(damped, target).clamp(-LONGEST, LONGEST))
                found = self.problem.errors(tried)
                new = self.cost(tried, found)
                if new < cost:
                    break
                damping *= 5
            else:
                return point, cost, taken
            gain, taken = 1 - new / cost, taken + 1
            point, errors, cost, damping = tried, found, new, max(damping / 5, 1e-7)
            if gain < GAIN:
                break
        return point, cost, taken
