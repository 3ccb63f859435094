"""Result of a servo fit: ratios of the parameters to kp, with 95 % intervals.

The covariance is a jackknife over logs (see `jackknife_covariance`): errors that the model cannot represent are
correlated over a whole log, so a log is one independent block. The interval of a parameter that the logs do not
determine is the interval of its prior.
"""

import math
from dataclasses import dataclass, replace

import torch
from scipy.special import stdtrit
from torch import Tensor

from spelgen.dynamics.parameters import evaluate_with
from spelgen.emission.assemble import ArmModel
from spelgen.fitting.levenberg_marquardt import NormalEquations
from spelgen.fitting.run_record import Content
from spelgen.fitting.servo.laws import sliding_friction
from spelgen.fitting.servo.parameters import DEAD_ZONE, ServoParameters
from spelgen.fitting.servo.problem import ServoProblem
from spelgen.fitting.servo.tuning import TUNING
from spelgen.identification.intervals import jackknife_covariance
from spelgen.listing import Listing, number

RATIOS = {
    "kd": ("kd/kp", "s"),
    "lag": ("lag", "s"),
    "armature": ("armature/kp", "s^2"),
    "dry": ("dry/kp", "rad, m"),
    "static_error": ("static error", "rad, m"),
    "dead_zone": ("half dead zone", "rad, m"),
}
"""Label and unit of each ratio of a parameter to kp.

lag: kd / kp plus the delay. dry: mean dry friction in motion / kp. static_error: dry plus half the dead zone.
"""
ABOUT = (
    "divided by kp, with half a 95 % interval. kp itself is scaled by the URDF's masses, unless it is known. kd is the "
    "sum of kd and viscous friction, which such logs do not distinguish. lag: the sum of kd/kp and the delay, one "
    "quantity in slow motion. dry: dry friction; open where it cannot be distinguished from a dead zone, as without "
    "gravity. static error: the sum of dry/kp and half the dead zone"
)


@dataclass(frozen=True)
class FitSummary:
    """Summary of a fit for the user.

    Attributes:
        text: summary for a terminal.
        listing: table of the parameters with intervals.
        headline: (value, name) of the delay of the commands, the most important result.
    """

    text: str
    listing: Listing
    headline: tuple[str, str]


@dataclass(frozen=True, eq=False)
class ServoSolution:
    """Normal equations and covariance of the k parameters at the end of a fit.

    The dead zones of all joints are free parameters here, unlike in the fit, where only joints with a dead zone have
    one.

    Attributes:
        blocks: normal equations of B blocks of windows, (B, k, k) and (B, k); a block is a log or a segment of a log.
        precision: (k,), inverse prior variance of each parameter.
        covariance: (k, k), jackknife covariance of the parameters.
    """

    blocks: NormalEquations
    precision: Tensor
    covariance: Tensor

    @property
    def quantile(self) -> float:
        """Half the width of a 95 % interval divided by the standard deviation, from Student's t."""
        # With few blocks, the quantile of Student's t distribution is larger than the Gaussian's 1.96.
        return float(stdtrit(max(1, len(self.blocks.curvature) - 1), 0.975))


def solution(problem: ServoProblem, x: ServoParameters) -> tuple[ServoParameters, ServoSolution]:
    """Take one Gauss-Newton step from x; return the parameters, their normal equations and their covariance.

    x is the result of a fit with longer integration steps than ``problem`` has. The step s is therefore an estimate of
    the integration error of x, and s s^T is added to the covariance. The normal equations are computed at x and
    extrapolated to x + s. The returned parameters are x + s, or x if the step raises the cost.
    """
    # The dead zones of all joints are free parameters here: if they were fixed at zero, the covariance of dry friction
    # would be too small.
    free, errors = replace(x, active=torch.ones_like(x.active)), problem.residual(x)
    numbers = problem.rollouts.windows.blocks(TUNING.min_logs, TUNING.min_blocks)
    blocks = NormalEquations(*(_sums(x, numbers) for x in problem.window_equations(free, errors)))
    precision = problem.parameters.precision(free)
    step = problem.with_prior(blocks, x).step()
    # The gradients are linearly extrapolated to the parameters after the step. There, the gradients of all blocks and
    # of the prior add up to zero, as the jackknife requires.
    blocks = blocks._replace(descent=blocks.descent - blocks.curvature @ step)
    end = x.after(step)
    # The Gauss-Newton step from x to `end` may raise the cost if a joint is near its break-away torque, where the
    # position errors are not linear in the parameters. In this case, x is returned.
    if problem.cost(end, problem.residual(end)) > problem.cost(x, errors):
        end = x
    _, covariance = jackknife_covariance(*blocks, torch.diag(precision))
    # The Gauss-Newton step, with shorter integration steps than the fit, estimates the integration error of x. It
    # counts as an error of one standard deviation, so its outer product is added to the covariance.
    return end, ServoSolution(blocks, precision, covariance + torch.outer(step, step))


def _sums(terms: Tensor, numbers: Tensor) -> Tensor:
    """Return the sums (B, ...) of terms of W windows, (W, ...), over the windows of each of B blocks.

    numbers: index of the block of each window, (W,).
    """
    return terms.new_zeros(int(numbers.max()) + 1, *terms.shape[1:]).index_add(0, numbers, terms)


def identifiable(blocks: NormalEquations, precision: Tensor, indices: Tensor) -> Tensor:
    """Return a mask (m,) of m parameters, True for parameters that the logs distinguish from all other parameters.

    A parameter is distinguished if its variance inflation factor is below `ServoTuning.variance_inflation`: the
    posterior variance of the parameter, divided by its variance if all other parameters were known. Example: dead zone
    and dry friction of a joint without gravity load are not distinguished, since the derivatives of the errors with
    respect to both are proportional.

    Args:
        blocks: normal equations of B blocks of windows with respect to all k parameters, (B, k, k) and (B, k); they are
            summed.
        precision: (k,), inverse prior variance of each parameter.
        indices: (m,), indices of the m parameters.
    """
    curvature = blocks.curvature.sum(dim=0)
    inverse = torch.linalg.inv(curvature + torch.diag(precision))
    inflation: Tensor = (curvature.diagonal() * inverse.diagonal())[indices]
    return inflation < TUNING.variance_inflation


def ratios(model: ArmModel, qd: Tensor, gravity: Tensor) -> dict[str, Tensor]:
    """Return {name: (n,)} of the quantities in `RATIOS`, such as kd / kp [s] and (dry friction) / kp [rad, m].

    Dry friction depends on velocity and gravity torque. Its mean over the samples is used (`sliding_friction`).

    Args:
        model: model with position servos.
        qd: velocities of the samples, (..., n) [rad/s, m/s].
        gravity: gravity torques of the samples, (..., n) [Nm, N].
    """
    servo, kp = model.servo, model.servo.kp()
    dry = sliding_friction(model.friction, qd, gravity) / kp
    return {
        "kd": servo.kd() / kp,
        "lag": servo.kd() / kp + servo.delay,
        "armature": model.armature / kp,
        "dry": dry,
        "static_error": dry + servo.dead_zone,
        "dead_zone": servo.dead_zone,
    }


def ratios_with_deviations(
    problem: ServoProblem, solution: ServoSolution
) -> dict[str, tuple[Tensor, Tensor]]:
    """Return {key of `RATIOS`: (ratios to kp, deviations)}, (n,) each, for the current parameters of the model.

    The deviations are the standard deviations of the logarithms of the ratios, from the covariance of ``solution``.
    """
    rollouts, parameters = problem.rollouts, problem.parameters
    tensors = {name: x.detach().clone().requires_grad_() for name, x in parameters.tensors.items()}
    qd, gravity = rollouts.motion.qd, rollouts.load.gravity
    values = evaluate_with(rollouts.model, tensors, lambda model: ratios(model, qd, gravity))
    p, n = parameters.prior_mean.joints.shape
    # `blocks` (p + 1, p + 1, n): for each joint, the covariance of the joint's p parameters and the common delay, which
    # is the last of the k parameters.
    index = torch.cat([torch.arange(p * n).view(p, n), torch.full((1, n), len(solution.covariance) - 1)])
    blocks = solution.covariance[index.unsqueeze(1), index.unsqueeze(0)]
    result = {}
    for name, value in values.items():
        # The ratio of a joint depends only on this joint's parameters and on the delay. The gradient of the sum of all
        # ratios therefore contains the derivatives of each ratio.
        derivatives = torch.autograd.grad(
            value.sum(), list(tensors.values()), retain_graph=True, materialize_grads=True
        )
        by_delay = torch.full((1, n), float(name == "lag")).double()
        relative = torch.cat([*(x.reshape(n, -1).mT for x in derivatives), by_delay]) / value.detach()
        variance = torch.einsum("pn,pqn,qn->n", relative, blocks, relative)
        result[name] = value.detach(), variance.clamp(min=0).sqrt()
    return result


def servo_record(problem: ServoProblem, solution: ServoSolution, x: ServoParameters, steps: int) -> Content:
    """Return the record of a servo fit for config.json: delay [s], RMS errors [rad, m], and parameters of each joint.

    The parameters of a joint are kp and the quantities of `RATIOS`, such as kd / kp, each with its 95 % interval. The
    entry "determined" of a quantity is True if the upper end of the interval is below `ServoTuning.max_factor` times
    its value. Dry friction / kp and dead zone must also be distinguishable from each other (see `identifiable`).

    x: fitted parameters. steps: number of Levenberg-Marquardt steps of the fit.
    """
    return {
        "delay": {"value": x.delay, "half": solution.quantile * float(solution.covariance[-1, -1].sqrt())},
        "rms": problem.residual(x).square().mean(dim=(0, 1)).sqrt().tolist(),
        "steps": steps,
        "joints": _joint_records(problem, solution),
    }


def _joint_records(problem: ServoProblem, solution: ServoSolution) -> list[Content]:
    model, records = problem.rollouts.model, []
    kp, trained = model.servo.kp().tolist(), model.servo.trained.tolist()
    values = ratios_with_deviations(problem, solution)
    dead_zones = problem.parameters.row(DEAD_ZONE) * model.n + torch.arange(model.n)
    distinct = identifiable(solution.blocks, solution.precision, dead_zones).tolist()
    for joint, name in enumerate(model.joint_names):
        record: Content = {"joint": name, "kp": {"value": kp[joint], "known": not trained[joint]}}
        for ratio, (of_joints, deviations) in values.items():
            value = float(of_joints[joint])
            # If no dead zone was selected at this joint, it is zero and has no interval.
            if ratio == "dead_zone" and not value:
                continue
            half = solution.quantile * math.hypot(TUNING.model_deviation, float(deviations[joint]))
            # The half width of the interval of the logarithm is limited to 50, so that exp does not overflow.
            factor = math.exp(min(half, 50.0))
            # The static error, a sum of dry friction and dead zone, may be determined even if its two terms are not.
            determined = factor < TUNING.max_factor and (distinct[joint] or ratio not in ("dry", "dead_zone"))
            record[ratio] = {
                "unit": RATIOS[ratio][1],
                "value": value,
                "low": value / factor,
                "high": value * factor,
                "determined": determined,
            }
        records.append(record)
    return records


def servo_summary(record: Content | None) -> FitSummary | None:
    """Return the summary of a `servo_record`; None if the fit has not finished, or if the arm has no servos."""
    if record is None:
        return None
    columns = [ratio for ratio in RATIOS if any(ratio in joint for joint in record["joints"])]
    rows: list[tuple[str, ...]] = []
    undetermined: dict[str, list[str]] = {}
    for joint in record["joints"]:
        cells = []
        for column in columns:
            interval = joint.get(column)
            # Only the interval of a dead zone can be None: no dead zone was selected at this joint.
            if interval is None:
                cells.append("none")
            elif interval["determined"]:
                width = 100 * (interval["high"] / interval["value"] - 1)
                cells.append(f"{number(interval['value'])} +- {width:.2g} %")
            else:
                cells.append("open")
                undetermined.setdefault(RATIOS[column][0], []).append(joint["joint"])
        rows.append((joint["joint"], number(joint["kp"]["value"]), *cells))
    head = ("joint", "kp [Nm/rad]", *("{} [{}]".format(*RATIOS[column]) for column in columns))
    end = "All ratios are determined"
    if undetermined:
        groups = [f"{ratio} of {', '.join(joints)}" for ratio, joints in undetermined.items()]
        end = f"Not determined by these logs: {'; '.join(groups)}"
    listing = Listing("Servos", head, rows, f"All columns but kp are {ABOUT}. {end}.")
    delay = f"{1000 * record['delay']['value']:.1f} ms, +- {1000 * record['delay']['half']:.1f} ms"
    errors = ", ".join(number(1000 * rms) for rms in record["rms"])
    text = f"delay {delay}\nerrors on training windows, RMS by joint: {errors} mrad\n{listing.text()}"
    return FitSummary(text, listing, (delay, "delay of the commands"))
