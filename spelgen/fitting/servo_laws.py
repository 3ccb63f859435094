"""Which joints have a dead zone, and which friction that only slow motion has: those far more probable with it.

Slopes do not tell: a joint that gravity does not load is held off its command alike by a dead zone and by dry friction,
and only how it starts, stops and turns round says which. So the arm is fitted with a law at all joints. Under the load
and the delay that this finds each joint is one by itself: it is fitted without the law, and from other starts, and
keeps what is most probable, where each law has to be worth more than luck.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch

from spelgen.fitting.servo_descent import Descent, Normal, Reached
from spelgen.fitting.servo_problem import ServoProblem, sliding_friction
from spelgen.fitting.servo_weights import COULOMB, DEAD_ZONE, STRIBECK, STRIBECK_VELOCITY, Point

SHARES = (0.2, 0.6)  # of what holds a joint off its command, that a dead zone does instead, to begin with
SURE = 3.0  # standard deviations
LEAST = 1e-3  # rad, m
INFLATION = 50.0  # of a variance, from which on two things are one: of simulated SO-101s below 30 or above 90
DAMPING, GAIN = 1e-3, 1.0  # of the descents


def with_laws(problem: ServoProblem, noise: torch.Tensor, point: Point) -> Point:
    """The point, with the laws that its joints turn out to have, which are fitted from now on.

    noise: of positions, (n,) [rad, m].
    """
    return _with_slow_friction(problem, noise, _with_dead_zones(problem, noise, point))


def without_faint(problem: ServoProblem, point: Point) -> Point:
    """The point, without dead zones that are next to none."""
    row, joints, present = problem.weights.row(DEAD_ZONE), point.joints.clone(), point.present.clone()
    present[row] &= joints[row] > LEAST
    joints[row] *= present[row]
    return replace(point, joints=joints, present=present)


def _with_dead_zones(problem: ServoProblem, noise: torch.Tensor, point: Point) -> Point:
    less, more = (_shared_out(problem, point, x) for x in SHARES)
    fitted, descent = _fitted(problem, noise, less)
    more = replace(more, bodies=fitted.bodies, delay=fitted.delay)
    found = _most_probable(descent, fitted, [more, _shared_out(problem, fitted, 0.0)])
    return found if found.present[problem.weights.row(DEAD_ZONE)].any() else point


def _with_slow_friction(problem: ServoProblem, noise: torch.Tensor, point: Point) -> Point:
    slow = problem.weights.with_all(point, STRIBECK, STRIBECK_VELOCITY)
    slow, descent = _fitted(problem, noise, slow)
    constant = replace(slow, joints=torch.where(point.present, slow.joints, 0.0), present=point.present)
    # what looked like a dead zone may have been friction that falls with velocity
    found = _most_probable(descent, slow, [constant, _shared_out(problem, slow, 0.0)])
    return found if found.present[problem.weights.row(STRIBECK)].any() else point


def _fitted(problem: ServoProblem, noise: torch.Tensor, point: Point) -> tuple[Point, Descent]:
    """Where all weights are most probable, and what scales errors there."""
    for reached in Descent(problem, noise, problem.errors(point)).steps(Reached(point, DAMPING), GAIN):
        point = reached.point
    return point, Descent(problem, noise, problem.errors(point))


def _most_probable(descent: Descent, point: Point, others: Sequence[Point]) -> Point:
    """Of each joint by itself, where each law has to be worth more than luck; under what this point's joints share."""
    ends = [(point, descent.costs(point, descent.problem.errors(point)))]
    ends += [descent.joint_by_joint(x, DAMPING, GAIN) for x in others]
    laws = [descent.problem.weights.row(x) for x in (DEAD_ZONE, STRIBECK)]
    costs = torch.stack([cost + SURE**2 * x.present[laws].sum(dim=0) for x, cost in ends])
    best = costs.nan_to_num(torch.inf).argmin(dim=0)
    joints, present = (
        torch.stack(x)[best, :, torch.arange(len(best))].mT
        for x in ([x.joints for x, _ in ends], [x.present for x, _ in ends])
    )
    return without_faint(descent.problem, replace(point, joints=joints, present=present))


def _shared_out(problem: ServoProblem, point: Point, share: float) -> Point:
    """What holds joints off their commands, done by dead zones to so much, the rest by dry friction."""
    problem.write(point)
    model, row = problem.model, problem.weights.row
    with torch.no_grad():
        torques = sliding_friction(model.friction, problem.along.qd, problem.load.gravity)
        dry = torques / model.kp
    joints, present = point.joints.clone(), point.present.clone()
    lost = dry + joints[row(DEAD_ZONE)].clamp(min=0.0)
    joints[row(DEAD_ZONE)] = share * lost
    joints[row(COULOMB)] += ((1 - share) * lost / dry).log()
    present[row(DEAD_ZONE)] = share > 0
    return replace(point, joints=joints, present=present)


def told_apart(normal: Normal, precision: torch.Tensor, places: torch.Tensor) -> torch.Tensor:
    """Whether windows tell a joint's dead zone from its dry friction and all else, (n,).

    By the variance inflation factor of dead zones: of joints that gravity does not load the slopes of errors by either
    are the same but for a factor, and what is linear in them says nothing of the one without the other.
    """
    matrix = normal.matrix.sum(dim=0)
    inverse = torch.linalg.inv(matrix + torch.diag(precision))
    inflation: torch.Tensor = (matrix.diagonal() * inverse.diagonal())[places]
    return inflation < INFLATION
