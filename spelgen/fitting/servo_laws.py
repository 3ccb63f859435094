"""Which joints have a dead zone, and which friction that only slow motion has: those far more probable with it.

Slopes do not tell: a joint that gravity does not load is held off its command alike by a dead zone and by dry friction,
and only how it starts, stops and turns round says which. So the arm is fitted with both laws at all joints. Under the
load and the delay that this finds each joint is one by itself: it is fitted with and without either, from several
starts, and keeps what is most probable, where each law has to be worth more than luck.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch

from spelgen.fitting.servo_descent import Descent, Normal, Reached
from spelgen.fitting.servo_problem import ServoProblem
from spelgen.fitting.servo_weights import DEAD_ZONE, FRICTION, STRIBECK, STRIBECK_VELOCITY, Point

SHARES = (0.2, 0.6)  # of what holds a joint off its command, that a dead zone does instead, to begin with
SURE = 3.0  # standard deviations
LEAST = 1e-3  # rad, m
INFLATION = 50.0  # of a variance, from which on two things are one: of simulated SO-101s below 30 or above 90
DAMPING, GAIN = 1e-3, 1.0  # of the descents


def with_laws(problem: ServoProblem, noise: torch.Tensor, point: Point) -> Point:
    """The point, with the laws that its joints turn out to have, which are fitted from now on."""
    less, more = (shared_out(problem, point, x, slow=False) for x in SHARES)
    point, descent = _fitted(problem, noise, less)
    none = shared_out(problem, point, 0.0, slow=False)
    point = _most_probable(descent, point, [replace(more, bodies=point.bodies, delay=point.delay), none])
    present = point.present.clone()
    present[[problem.weights.row(x) for x in (STRIBECK, STRIBECK_VELOCITY)]] = True
    slow, descent = _fitted(problem, noise, replace(point, present=present))
    constant = replace(slow, joints=torch.where(point.present, slow.joints, 0.0), present=point.present)
    none = shared_out(problem, slow, 0.0, slow=True)
    return _most_probable(descent, slow, [constant, none])


def _fitted(problem: ServoProblem, noise: torch.Tensor, point: Point) -> tuple[Point, Descent]:
    """Where all weights are most probable, and what scales errors there."""
    for reached in Descent(problem, noise, problem.errors(point)).steps(Reached(point, DAMPING), GAIN):
        point = reached.point
    return point, Descent(problem, noise, problem.errors(point))


def _most_probable(descent: Descent, point: Point, others: Sequence[Point]) -> Point:
    """Of each joint by itself, where each law has to be worth more than luck; under what this point's joints share."""
    ends = [(point, descent.costs(point, descent.problem.errors(point)))]
    ends += [descent.joint_by_joint(x, DAMPING, GAIN) for x in others]
    rows = [descent.problem.weights.row(x) for x in (DEAD_ZONE, STRIBECK)]
    costs = torch.stack([cost + SURE**2 * x.present[rows].sum(dim=0) for x, cost in ends])
    best = costs.nan_to_num(torch.inf).argmin(dim=0)
    joints, present = (
        torch.stack(x)[best, :, torch.arange(len(best))].mT
        for x in ([x.joints for x, _ in ends], [x.present for x, _ in ends])
    )
    return without_faint(descent.problem, replace(point, joints=joints, present=present))


def without_faint(problem: ServoProblem, point: Point) -> Point:
    """The point, without dead zones that are next to none."""
    row, joints, present = problem.weights.row(DEAD_ZONE), point.joints.clone(), point.present.clone()
    present[row] &= joints[row] > LEAST
    joints[row] *= present[row]
    return replace(point, joints=joints, present=present)


def shared_out(problem: ServoProblem, point: Point, share: float, *, slow: bool) -> Point:
    """What holds joints off their commands, done by dead zones to so much, the rest by dry friction."""
    problem.write(point)
    model, qd, row = problem.model, problem.along.qd, problem.weights.row
    friction, joints, present = model.dynamics.friction, point.joints.clone(), point.present.clone()
    with torch.no_grad():
        dry = friction.dry(qd, problem.load.gravity, friction.prepare())
        off = (dry * qd.abs()).sum(dim=(0, 1)) / qd.abs().sum(dim=(0, 1)) / model.kp
    lost = off + joints[row(DEAD_ZONE)].clamp(min=0.0)
    joints[row(DEAD_ZONE)] = share * lost
    joints[row(FRICTION + "coulomb")] += ((1 - share) * lost / off).log()
    present[row(DEAD_ZONE)] = share > 0
    present[[row(STRIBECK), row(STRIBECK_VELOCITY)]] = slow
    return replace(point, joints=torch.where(present, joints, 0.0), present=present)


def told_apart(normal: Normal, precision: torch.Tensor, places: torch.Tensor) -> torch.Tensor:
    """Whether windows tell a joint's dead zone from its dry friction and all else, (n,).

    By the variance inflation factor of dead zones: of joints that gravity does not load the slopes of errors by either
    are the same but for a factor, and what is linear in them says nothing of the one without the other.
    """
    matrix = normal.matrix.sum(dim=0)
    inverse = torch.linalg.inv(matrix + torch.diag(precision))
    inflation: torch.Tensor = (matrix.diagonal() * inverse.diagonal())[places]
    return inflation < INFLATION
