"""Selection of the joints that have a dead zone: fits with and without a dead zone are compared.

Each joint is fitted twice, from initial parameters with and without a dead zone. The dead zone is kept if it lowers the
joint's negative log posterior by more than significance^2 / 2. Load, delay and the scale of the errors are fixed at
the preceding fit in both fits, so that the joints are independent.

A single linearized fit does not suffice at joints without gravity load. There, a dead zone and dry friction both cause
a static position error, and the derivatives of the errors with respect to both are proportional. Only the motion at
starts, stops and reversals distinguishes them.
"""

from dataclasses import replace

import torch
from torch import Tensor

from spelgen.fitting.levenberg_marquardt import NormalEquations
from spelgen.fitting.servo.parameters import COULOMB, DEAD_ZONE, ServoParameters
from spelgen.fitting.servo.problem import ServoProblem
from spelgen.fitting.servo.tuning import TUNING
from spelgen.fitting.tuning import TUNING as DAMPING
from spelgen.runtime.friction_laws import FrictionLaws


def select_dead_zones(problem: ServoProblem, x: ServoParameters) -> ServoParameters:
    """Fit each joint with and without a dead zone from x; return the better parameters of each joint.

    x: parameters of the preceding fit, without dead zones. A dead zone is kept only if it lowers the joint's cost, its
    negative log posterior, by more than significance^2 / 2 (`ServoTuning.significance`).
    """
    problem = problem.reweighted(x)
    without, costs_without = _joint_minima(problem, x)
    with_zones, costs_with = _joint_minima(problem, with_dead_zones(problem, x, TUNING.dead_zone_fraction))
    # If a rollout with a dead zone diverged, the cost is NaN or infinite, and no dead zone is selected. Costs without a
    # dead zone are finite, since the rollouts at x are finite.
    better = costs_with + TUNING.significance**2 / 2 < costs_without
    joints, active = torch.where(better, with_zones.joints, without.joints), x.active.clone()
    active[problem.parameters.row(DEAD_ZONE)] = better
    return without_small_dead_zones(problem, replace(x, joints=joints, active=active))


def without_small_dead_zones(problem: ServoProblem, x: ServoParameters) -> ServoParameters:
    """Return x with small dead zones set to zero and excluded from the fit; its other parameters are unchanged.

    A dead zone is small if its half width [rad, m] is at most `TUNING.min_dead_zone`. This bound is about the
    resolution of encoders: smaller dead zones cannot be measured.
    """
    row, joints, active = problem.parameters.row(DEAD_ZONE), x.joints.clone(), x.active.clone()
    active[row] &= joints[row] > TUNING.min_dead_zone
    joints[row] *= active[row]
    return replace(x, joints=joints, active=active)


def _joint_minima(problem: ServoProblem, x: ServoParameters) -> tuple[ServoParameters, Tensor]:
    """Minimize the cost of each joint over its own parameters from x; return the parameters and the costs, (n,).

    The method is Levenberg-Marquardt. Each joint has its own damping and termination, since a joint with a poor initial
    guess would slow down all others otherwise. The rollouts of all joints form one batch.
    """
    errors = problem.residual(x)
    costs = problem.joint_costs(x, errors)
    damping, active = torch.full_like(costs, DAMPING.initial_damping), torch.ones_like(costs).bool()
    p, n = x.joints.shape
    for _ in range(TUNING.joint_steps):
        normal = problem.normal_equations(x, errors)
        # Only the blocks of the Hessian with respect to the p parameters of one joint are used, (n, p, p), with the
        # negative gradients (n, p).
        blocks = normal.curvature[: p * n, : p * n].view(p, n, p, n).diagonal(dim1=1, dim2=3)
        joints = NormalEquations(blocks.permute(2, 0, 1), normal.descent[: p * n].view(p, n).mT)
        steps = joints.step(damping).clamp(-TUNING.max_step, TUNING.max_step)
        candidate = replace(x, joints=x.joints + steps.mT * x.active)
        candidate_errors = problem.residual(candidate)
        candidate_costs = problem.joint_costs(candidate, candidate_errors)
        better = active & (candidate_costs < costs)
        # A joint is no longer fitted (`active` becomes False) after a step that lowers its cost by less than
        # `min_decrease`. A step that raises the cost is rejected, and the next one is tried with more damping.
        active &= ~better | (costs - candidate_costs >= TUNING.min_decrease)
        x = replace(x, joints=torch.where(better, candidate.joints, x.joints))
        errors = torch.where(better, candidate_errors, errors)
        costs = torch.where(better, candidate_costs, costs)
        damping = torch.where(better, damping / DAMPING.damping_factor, damping * DAMPING.damping_factor / 2)
        if not active.any():
            break
    return x, costs


def with_dead_zones(problem: ServoProblem, x: ServoParameters, fraction: float) -> ServoParameters:
    """Return parameters x with a dead zone at every joint, as the initial guess of a fit of dead zones.

    All parameters of the result are marked as fitted (`active`). As a side effect, x is written to the problem's model.
    The static position error of a servo is (dry friction) / kp plus half the width of the dead zone. This half width is
    set to ``fraction`` times (dry friction) / kp, and Coulomb friction is reduced by the same fraction. The static
    error remains about the same, or exactly the same if Coulomb friction is the only dry friction.
    """
    rollouts, row, joints = problem.rollouts, problem.parameters.row, x.joints.clone()
    model = rollouts.model
    problem.parameters.write(x)
    with torch.no_grad():
        dry = sliding_friction(model.friction, rollouts.motion.qd, rollouts.load.gravity)
    joints[row(DEAD_ZONE)] = fraction * dry / model.servo.kp().detach()
    # The parameter is the logarithm of Coulomb friction, so the logarithm of the factor 1 - fraction is added.
    joints[row(COULOMB)] += torch.tensor(1 - fraction).log()
    return replace(x, joints=joints, active=torch.ones_like(x.active))


def sliding_friction(friction: FrictionLaws, qd: Tensor, gravity: Tensor) -> Tensor:
    """Return the magnitude of each joint's dry friction in motion, (n,) [Nm, N].

    The magnitude is a mean over samples, weighted by |qd|.

    Args:
        friction: friction model.
        qd: velocities, (..., n) [rad/s, m/s].
        gravity: gravity torques, (..., n) [Nm, N].
    """
    # Without the term 1e-9 the mean of a joint at rest would be 0 / 0.
    speed = qd.abs() + 1e-9
    dry = friction.prepare().dry(qd, gravity) * speed
    return dry.flatten(0, -2).sum(dim=0) / speed.flatten(0, -2).sum(dim=0)
