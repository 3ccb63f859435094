"""Select which joints have a dead zone: those far more probable with it.

Slopes of errors do not tell: a joint that gravity does not load is held off its command alike by a dead zone and by dry
friction, and only how it starts, stops and turns round says which. Under the load and the delay of a fit each joint is
one by itself: it is fitted from other starts, and keeps what is most probable, where a dead zone has to be worth more
than luck.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch

from spelgen.fitting.levenberg_marquardt import TUNING as DAMPING
from spelgen.fitting.levenberg_marquardt import NormalEquations
from spelgen.fitting.servo.parameters import COULOMB, DEAD_ZONE, ServoParameters
from spelgen.fitting.servo.problem import LONGEST_STEP, ServoProblem
from spelgen.fitting.servo.tuning import ServoLawTuning, ServoSolverTuning

TUNING, SOLVER = ServoLawTuning(), ServoSolverTuning()


def select_dead_zones(problem: ServoProblem, x: ServoParameters) -> ServoParameters:
    """Return parameters with the dead zones that the joints turn out to have, which are fitted from then on."""
    problem.weigh(problem.residual(x))
    plain, plain_costs = _joint_minima(problem, x)
    zoned, zoned_costs = _joint_minima(problem, divided(problem, x, TUNING.dead_zone_fraction))
    better = zoned_costs + TUNING.significance**2 / 2 < plain_costs  # never where a rollout left all bounds
    joints, active = torch.where(better, zoned.joints, plain.joints), x.active.clone()
    active[problem.rows.row(DEAD_ZONE)] = better
    return without_faint(problem, replace(x, joints=joints, active=active))


def without_faint(problem: ServoProblem, x: ServoParameters) -> ServoParameters:
    """Return the parameters without dead zones that are next to none."""
    row, joints, active = problem.rows.row(DEAD_ZONE), x.joints.clone(), x.active.clone()
    active[row] &= joints[row] > TUNING.least_dead_zone
    joints[row] *= active[row]
    return replace(x, joints=joints, active=active)


def _joint_minima(problem: ServoProblem, x: ServoParameters) -> tuple[ServoParameters, torch.Tensor]:
    """Return where each joint's own parameters are most probable, under what all share, and what that costs, (n,).

    Each joint has a damping of its own: one for all would follow the joint that is worst off, and others end early.
    """
    errors = problem.residual(x)
    costs = problem.joint_costs(x, errors)
    damping, active = torch.full_like(costs, DAMPING.initial), torch.ones_like(costs).bool()
    p, n = x.joints.shape
    for _ in range(TUNING.steps):
        normal = problem.normal_equations(x, errors)
        blocks = normal.curvature[: p * n, : p * n].view(p, n, p, n).diagonal(dim1=1, dim2=3)
        joints = NormalEquations(blocks.permute(2, 0, 1), normal.descent[: p * n].view(p, n).mT)
        steps = joints.step(damping).clamp(-LONGEST_STEP, LONGEST_STEP)
        moved = replace(x, joints=x.joints + steps.mT * x.active)
        moved_errors = problem.residual(moved)
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


def divided(problem: ServoProblem, x: ServoParameters, fraction: float) -> ServoParameters:
    """Return parameters where dead zones are this fraction of the static error, and dry friction the rest."""
    problem.write(x)
    with torch.no_grad():
        dry = sliding_friction(problem.model.friction, problem.along.qd, problem.load.gravity)
    row, joints = problem.rows.row, x.joints.clone()
    joints[row(DEAD_ZONE)] = fraction * dry / problem.model.kp.detach()
    # the parameter is a logarithm
    joints[row(COULOMB)] += torch.tensor(1 - fraction).log()
    return replace(x, joints=joints, active=torch.ones_like(x.active))


def sliding_friction(friction: Any, qd: torch.Tensor, gravity: torch.Tensor) -> torch.Tensor:
    """Return dry friction of each joint, (n,) [Nm, N], over what it slid; qd and gravity's torque: (..., n)."""
    slid = qd.abs() + 1e-9  # so that joints which never move have friction
    dry = friction.prepare().dry(qd, gravity) * slid
    mean: torch.Tensor = dry.flatten(0, -2).sum(dim=0) / slid.flatten(0, -2).sum(dim=0)
    return mean
