"""Fit position servos, friction and weight of an arm to logs of commanded positions: its most probable weights.

First least squares on the command error (`servo_start`), then predicted windows, by Levenberg-Marquardt steps on

    sum over joints and samples of 4 log(1 + (error / scale)^2 / 4) / alike + |(weights - start) / deviation|^2,

Student's t with three degrees of freedom: a joint that is held by something unknown, a table maybe, counts little.
The scale of a joint is what its errors usually are, and alike how many samples err alike, found in rounds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import torch

from spelgen.dynamics.bristles import encoder_step
from spelgen.fitting.servo_problem import ServoProblem
from spelgen.fitting.servo_start import start_servos
from spelgen.fitting.servo_weights import Point
from spelgen.fitting.servo_windows import ServoWindows
from spelgen.logs.trajectory import Trajectory

ALIKE = 0.5  # s over which errors may be alike
ROUNDS, STEPS, TRIES = 5, 12, 6
FINE = 2  # rounds at the end with all steps between samples, the others with half of them
LONGEST = 1.0  # of a step, in any weight: they are logarithms
GAIN = (
    1.0,
    0.05,
)  # of the cost, in rounds before the fine ones, and in these: a step that gains less ends a round
DAMPING = (1e-2, 1e-5)  # to begin with, in the first round and in the others


class Normal(NamedTuple):
    """Of each window, half the second and first derivatives of the cost (W, k, k), (W, k), by Gauss and Newton."""

    matrix: torch.Tensor
    target: torch.Tensor


@dataclass(frozen=True, eq=False)
class ServoSolution:
    """How a fit ended. rms: (n,) root mean square errors of positions over windows [rad, m]. names: of the rows of
    weights of joints, (p, n), which with directions of bodies and the delay are the k unknowns of `Point.flat`.
    normal: of windows there; precision: (k,) of the prior; halved: (k,) what half as long steps of the rollouts still
    changed at the end. gravity: (n,) mean size of its torque along the windows.
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
    point, steps = problem.start, 0
    for turn in range(ROUNDS):
        fine = turn >= ROUNDS - FINE
        if fine:
            problem.windows = windows
        if turn:
            problem.relinearise(point, problem.path(point))
        descent = Descent(problem, noise, problem.errors(point))
        point, cost, taken = descent.run(point, DAMPING[turn > 0], GAIN[fine])
        steps += taken
    problem.windows = replace(windows, steps=2 * windows.steps)
    normal = descent.normal(point, problem.errors(point))
    halved = descent.step(normal, point)
    point = point.moved(halved)
    problem.write(point)
    errors = problem.errors(point)
    return ServoSolution(
        tuple(problem.weights.names), errors.square().mean(dim=(0, 1)).sqrt(), steps, cost,
        normal, descent.precision, halved, problem.load.gravity.abs().mean(dim=(0, 1)),
    )  # fmt: skip


class Descent:
    """Steps with one scale of errors (n,), of which so many (n,) are alike."""

    def __init__(self, problem: ServoProblem, noise: torch.Tensor, errors: torch.Tensor) -> None:
        self.problem, self.centre = problem, problem.start.flat
        self.precision = problem.weights.deviations(problem.directions.shape[1]) ** -2
        self.scale = torch.maximum(1.4826 * errors.abs().flatten(0, 1).median(dim=0).values, noise)
        self.alike = _alike(errors * self._robust(errors), max(1, round(ALIKE * problem.windows.rate)))

    def _robust(self, errors: torch.Tensor) -> torch.Tensor:
        return 1 / (1 + (errors / self.scale).square() / 4)

    def cost(self, point: Point, errors: torch.Tensor) -> float:
        """Infinite where a rollout left all bounds."""
        if not errors.isfinite().all():
            return float("inf")
        squares = (errors / self.scale).square()
        away = point.flat - self.centre
        return float(
            (4 * torch.log1p(squares / 4) / self.alike).sum() + (self.precision * away.square()).sum()
        )

    def normal(self, point: Point, errors: torch.Tensor) -> Normal:
        """Of the windows alone, without the prior."""
        own, shared = self.problem.slopes(point, errors)
        weight = self._robust(errors) / self.scale**2 / self.alike
        p, (count, _, n), s = len(own), errors.shape, len(shared)
        matrix, target = (
            torch.zeros(count, p * n + s, p * n + s).double(),
            torch.zeros(count, p * n + s).double(),
        )
        for k in range(n):
            slope = torch.cat([own[..., k], shared[..., k]]).transpose(0, 1)  # (W, p + s, K')
            rows = torch.cat([torch.arange(p) * n + k, p * n + torch.arange(s)])
            weighted = slope * weight[:, None, :, k]
            matrix[:, rows[:, None], rows] += weighted @ slope.mT
            target[:, rows] += (weighted @ errors[..., k].unsqueeze(-1)).squeeze(-1)
        return Normal(matrix, target)

    def step(self, normal: Normal, point: Point, damping: float = 0.0) -> torch.Tensor:
        """To where the cost is least by its first two derivatives, (k,)."""
        matrix = normal.matrix.sum(dim=0) + torch.diag(self.precision)
        target = normal.target.sum(dim=0) + self.precision * (point.flat - self.centre)
        damped = matrix + damping * torch.diag(matrix.diagonal())
        return -torch.linalg.solve(damped, target).clamp(-LONGEST, LONGEST)

    def run(self, point: Point, damping: float, least: float) -> tuple[Point, float, int]:
        """The point where steps gain no more, its cost, and how many there were."""
        errors = self.problem.errors(point)
        cost, taken = self.cost(point, errors), 0
        for _ in range(STEPS):
            normal = self.normal(point, errors)
            for _ in range(TRIES):
                tried = point.moved(self.step(normal, point, damping))
                found = self.problem.errors(tried)
                new = self.cost(tried, found)
                if new < cost:
                    break
                damping *= 5
            else:
                return point, cost, taken
            gain, taken = cost - new, taken + 1
            point, errors, cost, damping = tried, found, new, max(damping / 10, 1e-7)
            if gain < least:
                break
        return point, cost, taken


def _alike(errors: torch.Tensor, span: int) -> torch.Tensor:
    """How many neighbours among errors (W, K', n) say the same, (n,): from 1 to ``span``."""
    blocks = errors[:, : errors.shape[1] // span * span].unflatten(1, (-1, span))
    together, apart = blocks.sum(dim=2).square().mean(dim=(0, 1)), blocks.square().sum(dim=2).mean(dim=(0, 1))
    return (together / apart.clamp(min=1e-300)).clamp(1.0, float(span))
