"""Select which joints have a dead zone, and which friction that falls with velocity: those far more probable with it.

Slopes of errors do not tell: a joint that gravity does not load is held off its command alike by a dead zone and by dry
friction, and only how it starts, stops and turns round says which. So the arm is fitted with a law at all joints. Under
the load and the delay that this finds each joint is one by itself: it is fitted without the law, and from other starts,
and keeps what is most probable, where each law has to be worth more than luck.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch

from spelgen.fitting.levenberg_marquardt import TUNING as DAMPING
from spelgen.fitting.levenberg_marquardt import levenberg_marquardt, start
from spelgen.fitting.servo.parameters import (
    COULOMB,
    DEAD_ZONE,
    STRIBECK,
    STRIBECK_VELOCITY,
    ServoParameters,
)
from spelgen.fitting.servo.problem import LONGEST_STEP, ServoProblem
from spelgen.settings.tuning.servo import ServoLawTuning, ServoSolverTuning

TUNING, SOLVER = ServoLawTuning(), ServoSolverTuning()


def select_laws(problem: ServoProblem, x: ServoParameters) -> ServoParameters:
    """Return parameters with the laws that the joints turn out to have, which are fitted from then on."""
    with_zones = descend(problem, divided(problem, x, TUNING.dead_zone_fraction))
    more = divided(problem, x, TUNING.larger_dead_zone_fraction)
    more = replace(more, bodies=with_zones.bodies, delay=with_zones.delay)
    chosen = _most_probable(problem, with_zones, [more, divided(problem, with_zones, 0.0)])
    if chosen.active[problem.rows.row(DEAD_ZONE)].any():
        x = chosen
    falling = descend(problem, problem.rows.activated(x, STRIBECK, STRIBECK_VELOCITY))
    constant = replace(falling, joints=torch.where(x.active, falling.joints, 0.0), active=x.active)
    # what looked like a dead zone may have been friction that falls with velocity
    chosen = _most_probable(problem, falling, [constant, divided(problem, falling, 0.0)])
    if chosen.active[problem.rows.row(STRIBECK)].any():
        x = chosen
    return x


def descend(problem: ServoProblem, x: ServoParameters) -> ServoParameters:
    """Return the most probable parameters near x; the likelihood is then that of errors there."""
    problem.weigh(x)
    *_, last = levenberg_marquardt(problem, start(problem, x), max_steps=SOLVER.steps, least_gain=SOLVER.gain)
    problem.weigh(last.x)
    return last.x


def _joint_minima(problem: ServoProblem, x: ServoParameters) -> tuple[ServoParameters, torch.Tensor]:
    """Return where each joint's own parameters are most probable, under what all share, and what that costs, (n,).

    Each joint has a damping of its own: one for all would follow the joint that is worst off, and others end early.
    """
    errors = problem.residuals(x)
    costs = problem.joint_costs(x, errors)
    damping, active = torch.full_like(costs, DAMPING.first), torch.ones_like(costs).bool()
    for _ in range(SOLVER.steps):
        steps = problem.joint_equations(x, errors).step(damping).clamp(-LONGEST_STEP, LONGEST_STEP)
        moved = replace(x, joints=x.joints + steps.mT * x.active)
        moved_errors = problem.residuals(moved)
        moved_costs = problem.joint_costs(moved, moved_errors)
        better = active & (moved_costs < costs)
        active &= torch.where(better, costs - moved_costs >= SOLVER.gain, damping < 1.0)
        x = replace(x, joints=torch.where(better, moved.joints, x.joints))
        errors = torch.where(better, moved_errors, errors)
        costs = torch.where(better, moved_costs, costs)
        damping = torch.where(better, damping / DAMPING.factor, damping * DAMPING.factor / 2)
        if not active.any():
            break
    return x, costs


def without_faint(problem: ServoProblem, x: ServoParameters) -> ServoParameters:
    """Return the parameters without dead zones that are next to none."""
    row, joints, active = problem.rows.row(DEAD_ZONE), x.joints.clone(), x.active.clone()
    active[row] &= joints[row] > TUNING.least_dead_zone
    joints[row] *= active[row]
    return replace(x, joints=joints, active=active)


def _most_probable(
    problem: ServoProblem, x: ServoParameters, alternatives: Sequence[ServoParameters]
) -> ServoParameters:
    """Return of each joint by itself the most probable parameters, under what x says of bodies and delay.

    Each law has to be worth more than luck.
    """
    candidates, costs = [x], [problem.joint_costs(x, problem.residuals(x))]
    for alternative in alternatives:
        minimum, joint_costs = _joint_minima(problem, alternative)
        candidates.append(minimum)
        costs.append(joint_costs)
    laws = [problem.rows.row(law) for law in (DEAD_ZONE, STRIBECK)]
    for candidate, cost in zip(candidates, costs, strict=True):
        cost += TUNING.significance**2 / 2 * candidate.active[laws].sum(dim=0)
    # where a rollout left all bounds, its cost is no number
    best = torch.stack(costs).nan_to_num(torch.inf).argmin(dim=0)
    joint = torch.arange(len(best))
    joints = torch.stack([candidate.joints for candidate in candidates])[best, :, joint].mT
    active = torch.stack([candidate.active for candidate in candidates])[best, :, joint].mT
    return without_faint(problem, replace(x, joints=joints, active=active))


def divided(problem: ServoProblem, x: ServoParameters, fraction: float) -> ServoParameters:
    """Return parameters where dead zones are this fraction of the static error, and dry friction the rest."""
    problem.write(x)
    with torch.no_grad():
        dry = sliding_friction(problem.model.friction, problem.along.qd, problem.load.gravity)
        dry = dry / problem.model.kp
    row = problem.rows.row
    joints, active = x.joints.clone(), x.active.clone()
    static_error = dry + joints[row(DEAD_ZONE)].clamp(min=0.0)
    joints[row(DEAD_ZONE)] = fraction * static_error
    # the parameter is a logarithm
    joints[row(COULOMB)] += ((1 - fraction) * static_error / dry).log()
    active[row(DEAD_ZONE)] = fraction > 0
    return replace(x, joints=joints, active=active)


def sliding_friction(friction: Any, qd: torch.Tensor, gravity: torch.Tensor) -> torch.Tensor:
    """Return dry friction of each joint, (n,) [Nm, N], over what it slid; qd and gravity's torque: (..., n)."""
    slid = qd.abs() + 1e-9  # so that joints which never move have friction
    dry = friction.dry(qd, gravity, friction.prepare()) * slid
    mean: torch.Tensor = dry.flatten(0, -2).sum(dim=0) / slid.flatten(0, -2).sum(dim=0)
    return mean
