"""Levenberg-Marquardt steps from weights of servos to their most probable ones, by what windows of logs say:

    sum over joints and samples of 4 log(1 + (error / scale)^2 / 4) / alike + |(weights - start) / deviation|^2,

Student's t with three degrees of freedom: a joint that is held by something unknown, a table maybe, counts little.
The scale of a joint is what its errors usually are, and alike how many samples err alike.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch

from spelgen.fitting.servo_problem import ServoProblem
from spelgen.fitting.servo_weights import Point

ALIKE = 0.5  # s over which errors may be alike
STEPS, TRIES = 12, 6
HARDEST = 1.0  # damping, after which no step is tried
LONGEST = 1.0  # of a step, in any weight: they are logarithms


class Normal(NamedTuple):
    """Of each window, half the second and first derivatives of the cost (W, k, k), (W, k), by Gauss and Newton."""

    matrix: torch.Tensor
    target: torch.Tensor


@dataclass(frozen=True, eq=False)
class Reached:
    """Where steps have come to. taken: how many there were in all, steps: since they began here; over: there is none
    to come. rms: of errors over windows, all joints [rad, m].
    """

    point: Point
    damping: float
    taken: int = 0
    steps: int = 0
    over: bool = False
    rms: float = math.inf


class Descent:
    """Steps with one scale of errors (n,), of which so many (n,) are alike."""

    def __init__(self, problem: ServoProblem, noise: torch.Tensor, errors: torch.Tensor) -> None:
        self.problem, self.centre = problem, problem.start.flat
        self.scale = torch.maximum(1.4826 * errors.abs().flatten(0, 1).median(dim=0).values, noise)
        self.alike = _alike(errors * self._robust(errors), max(1, round(ALIKE * problem.windows.rate)))

    def _robust(self, errors: torch.Tensor) -> torch.Tensor:
        return 1 / (1 + (errors / self.scale).square() / 4)

    def _weight(self, errors: torch.Tensor) -> torch.Tensor:
        return self._robust(errors) / self.scale**2 / self.alike

    def square(self, errors: torch.Tensor) -> float:
        """Their weighted sum of squares."""
        return float((self._weight(errors) * errors.square()).sum())

    def costs(self, point: Point, errors: torch.Tensor) -> torch.Tensor:
        """By joint, (n,), without that of weights which all share."""
        squares = (errors / self.scale).square()
        away = self._away(point)[: point.joints.numel()].view_as(point.joints)
        return (4 * torch.log1p(squares / 4) / self.alike).sum(dim=(0, 1)) + away.sum(dim=0)

    def cost(self, point: Point, errors: torch.Tensor) -> float:
        """Infinite where a rollout left all bounds."""
        if not errors.isfinite().all():
            return float("inf")
        shared = self._away(point)[point.joints.numel() :]
        return float(self.costs(point, errors).sum() + shared.sum())

    def _away(self, point: Point) -> torch.Tensor:
        """The prior's part of the cost, (k,)."""
        return self.problem.weights.precision(point) * (point.flat - self.centre).square()

    def normal(self, point: Point, errors: torch.Tensor) -> Normal:
        """Of the windows alone, without the prior."""
        own, shared = self.problem.slopes(point, errors)
        weight = self._weight(errors)
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
        precision = self.problem.weights.precision(point)
        matrix = normal.matrix.sum(dim=0) + torch.diag(precision)
        target = normal.target.sum(dim=0) + precision * (point.flat - self.centre)
        return _damped_step(matrix, target, torch.tensor(damping, dtype=torch.float64))

    def steps(self, reached: Reached, least: float) -> Iterator[Reached]:
        """One after the other; the last is one that gains less than ``least``, or none where none gains."""
        point, damping = reached.point, reached.damping
        errors = self.problem.errors(point)
        cost = self.cost(point, errors)
        while not reached.over:
            normal = self.normal(point, errors)
            for _ in range(TRIES):
                tried = point.moved(self.step(normal, point, damping))
                found = self.problem.errors(tried)
                new = self.cost(tried, found)
                if new < cost:
                    break
                damping *= 5
            else:
                yield replace(reached, damping=damping, over=True)
                return
            over = cost - new < least or reached.steps + 1 == STEPS
            point, errors, cost, damping = tried, found, new, max(damping / 10, 1e-7)
            rms = float(errors.square().mean().sqrt())
            reached = Reached(point, damping, reached.taken + 1, reached.steps + 1, over, rms)
            yield reached

    def joint_by_joint(self, point: Point, damping: float, least: float) -> tuple[Point, torch.Tensor]:
        """Where each joint's own weights are most probable, under what all share, and what that costs, (n,).

        Each joint has its own steps, and ends with one that gains less than ``least``, or where none gains.
        """
        errors = self.problem.errors(point)
        costs = self.costs(point, errors)
        damped, going = torch.full_like(costs, damping), torch.ones_like(costs).bool()
        for _ in range(STEPS):
            tried = self._joints_moved(point, errors, damped)
            found = self.problem.errors(tried)
            new = self.costs(tried, found)
            better = going & (new < costs)
            going &= torch.where(better, costs - new >= least, damped < HARDEST)
            point = replace(point, joints=torch.where(better, tried.joints, point.joints))
            errors, costs = torch.where(better, found, errors), torch.where(better, new, costs)
            damped = torch.where(better, (damped / 10).clamp(min=1e-7), damped * 5)
            if not going.any():
                break
        return point, costs

    def _joints_moved(self, point: Point, errors: torch.Tensor, damping: torch.Tensor) -> Point:
        """A step of each joint by itself, with its own damping (n,)."""
        slopes = self.problem.joint_slopes(point, errors).flatten(1, 2).permute(2, 0, 1)  # (n, p, M)
        weight, (p, n) = self._weight(errors).flatten(0, 1).mT, point.joints.shape
        own = slice(0, p * n)
        precision = self.problem.weights.precision(point)[own].view(p, n).mT
        away = (point.flat - self.centre)[own].view(p, n).mT
        matrix = (slopes * weight.unsqueeze(1)) @ slopes.mT + torch.diag_embed(precision)
        target = (slopes @ (weight * errors.flatten(0, 1).mT).unsqueeze(-1)).squeeze(-1) + precision * away
        return replace(point, joints=point.joints + _damped_step(matrix, target, damping).mT * point.present)


def _damped_step(matrix: torch.Tensor, target: torch.Tensor, damping: torch.Tensor) -> torch.Tensor:
    """By derivatives (..., k, k) and (..., k), each with its own damping (...), (..., k)."""
    damped = matrix + damping[..., None, None] * torch.diag_embed(matrix.diagonal(dim1=-2, dim2=-1))
    return -torch.linalg.solve(damped, target).clamp(-LONGEST, LONGEST)


def _alike(errors: torch.Tensor, span: int) -> torch.Tensor:
    """How many neighbours among errors (W, K', n) say the same, (n,): from 1 to ``span``."""
    blocks = errors[:, : errors.shape[1] // span * span].unflatten(1, (-1, span))
    together, apart = blocks.sum(dim=2).square().mean(dim=(0, 1)), blocks.square().sum(dim=2).mean(dim=(0, 1))
    return (together / apart.clamp(min=1e-300)).clamp(1.0, float(span))
