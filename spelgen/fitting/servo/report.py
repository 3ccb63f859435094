"""Report what logs of commanded positions determine: ratios to kp with intervals, and what they leave open.

Errors of neighbouring samples are alike, and those of one motion are: what a model lacks shows otherwise in another. So
what a log says is taken as one observation (the jackknife of a weighted least squares; one step without each log, see
Cameron and Miller, J. Human Resources 50:317, 2015, CV3). What logs do not determine stays as unsure as the prior.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch
from scipy.special import stdtrit

from spelgen.fitting.functional_model import evaluate_with
from spelgen.fitting.levenberg_marquardt import NormalEquations
from spelgen.fitting.run_record import Content
from spelgen.fitting.servo.laws import sliding_friction
from spelgen.fitting.servo.parameters import DEAD_ZONE, ServoParameters
from spelgen.fitting.servo.problem import ServoProblem
from spelgen.fitting.servo.tuning import ServoIntervalTuning
from spelgen.listing import Listing, number

if TYPE_CHECKING:
    from spelgen.emission.assemble import ArmModel

TUNING = ServoIntervalTuning()
QUANTILE = 0.975  # of an interval of 95 %, of Student's t: windows are few
RATIOS = {
    "kd": ("kd/kp", "s"),
    "armature": ("armature/kp", "s^2"),
    "dry": ("dry/kp", "rad, m"),
    "static_error": ("static error", "rad, m"),
    "dead_zone": ("half dead zone", "rad, m"),
}
"""The ratios to kp, with labels and units; dry: friction of a joint that slides, over what it slid; static_error: dry
and half the dead zone, together."""
ABOUT = (
    "divided by kp, with half a 95 % interval. kp itself is scaled by the URDF's masses, unless it is known. kd is the "
    "sum of kd and viscous friction, which such logs do not distinguish. dry: dry friction; open where it cannot be "
    "distinguished from a dead zone, as without gravity. static error: the sum of dry/kp and half the dead zone"
)


@dataclass(frozen=True)
class FitSummary:
    """Hold what a fit determined, for people.

    text: for a terminal. listing: parameters with their intervals. headline: the first figure, and what it is.
    """

    text: str
    listing: Listing
    headline: tuple[str, str]


@dataclass(frozen=True, eq=False)
class ServoSolution:
    """Hold what windows determine where a fit ended: their normal equations by stretch of the logs, of dead
    zones at all joints too, the precision (k,) of the prior, and the covariance (k, k) of the parameters.
    """

    windows: NormalEquations
    precision: torch.Tensor
    covariance: torch.Tensor

    @property
    def quantile(self) -> float:
        """Return how many standard deviations half an interval is."""
        return float(stdtrit(max(1, len(self.windows.curvature) - 1), QUANTILE))


def solution(problem: ServoProblem, x: ServoParameters) -> tuple[ServoParameters, ServoSolution]:
    """Return where one more step leads from x, of a fit with longer steps of the rollouts, and what windows determine
    there; what the step changes is added to the covariance. Parameters stay at x where the step raises the cost.
    """
    # a dead zone that a joint does not have makes its dry friction no better known
    free, errors = replace(x, active=torch.ones_like(x.active)), problem.residual(x)
    windows = problem.window_equations(free, errors)
    windows = by_stretch(windows, problem.windows.stretches(TUNING.logs, TUNING.stretches))
    precision = problem.rows.precision(free)
    step = problem.with_prior(windows, x).step()
    # where the fit ends, the slopes of all windows and of the prior add up to nothing
    windows = windows._replace(descent=windows.descent - windows.curvature @ step)
    end = x.moved(step)
    # where joints just slip, errors are far from linear in the parameters
    if problem.cost(end, problem.residual(end)) > problem.cost(x, errors):
        end = x
    return end, ServoSolution(windows, precision, covariance(windows, precision, step))


def by_stretch(windows: NormalEquations, stretches: torch.Tensor) -> NormalEquations:
    """Return the sums of windows' normal equations (W, ...) over the stretches that these are of, (W,)."""

    def summed(terms: torch.Tensor) -> torch.Tensor:
        sums = terms.new_zeros(int(stretches.max()) + 1, *terms.shape[1:])
        return sums.index_add(0, stretches, terms)

    return NormalEquations(*map(summed, windows))


def covariance(windows: NormalEquations, precision: torch.Tensor, halved: torch.Tensor) -> torch.Tensor:
    """Return that of the unknowns, (k, k): S^-1 (B + P) S^-1, of which the jackknife gives the first term, P is the
    prior's; and as much as they changed when steps were halved (k,).
    """
    count, prior = len(windows.curvature), torch.diag(precision)
    total = windows.curvature.sum(dim=0) + prior
    # where the fit ended, the slopes of all windows and of the prior add up to nothing
    shifts = torch.linalg.solve(total - windows.curvature, -windows.descent.unsqueeze(-1)).squeeze(-1)
    shifts = shifts - shifts.mean(dim=0)
    inverse = torch.linalg.inv(total)
    jackknife = (count - 1) / count * shifts.mT @ shifts
    result: torch.Tensor = jackknife + inverse @ prior @ inverse + torch.outer(halved, halved)
    return result


def identifiable(windows: NormalEquations, precision: torch.Tensor, unknowns: torch.Tensor) -> torch.Tensor:
    """Return whether windows tell these unknowns (m,) from all others, by their variance inflation factors, (m,).

    Of joints that gravity does not load the slopes of errors by a dead zone and by dry friction are the same but for a
    factor, and what is linear in them says nothing of the one without the other.
    """
    curvature = windows.curvature.sum(dim=0)
    inverse = torch.linalg.inv(curvature + torch.diag(precision))
    inflation: torch.Tensor = (curvature.diagonal() * inverse.diagonal())[unknowns]
    return inflation < TUNING.variance_inflation


def ratios(model: ArmModel, qd: torch.Tensor, gravity: torch.Tensor) -> dict[str, torch.Tensor]:
    """Return the ratios to kp, each (n,), of a model that moved at qd under gravity's torques, (..., n)."""
    dead_zone = model.servo.dead_zone
    dry = sliding_friction(model.friction, qd, gravity) / model.kp
    return {
        "kd": model.kd / model.kp,
        "armature": model.armature / model.kp,
        "dry": dry,
        "static_error": dry + dead_zone,
        "dead_zone": dead_zone,
    }


def ratios_with_deviations(
    problem: ServoProblem, solution: ServoSolution
) -> dict[str, tuple[torch.Tensor, torch.Tensor]]:
    """Return the ratios to kp, and the standard deviations of their logarithms, each (n,)."""
    tensors = {name: x.detach().clone().requires_grad_() for name, x in problem.rows.tensors.items()}
    qd, gravity = problem.along.qd, problem.load.gravity
    values = evaluate_with(problem.model, tensors, lambda model: ratios(model, qd, gravity))
    p, n = problem.start.joints.shape
    blocks = solution.covariance[: p * n, : p * n].view(p, n, p, n).diagonal(dim1=1, dim2=3)  # (p, p, n)
    result = {}
    for name, value in values.items():
        # the ratio of a joint depends on that joint's parameters alone
        slopes = torch.autograd.grad(
            value.sum(), list(tensors.values()), retain_graph=True, materialize_grads=True
        )
        relative = torch.cat([x.reshape(n, -1).mT for x in slopes]) / value.detach()
        variance = torch.einsum("pn,pqn,qn->n", relative, blocks, relative)
        result[name] = value.detach(), variance.clamp(min=0).sqrt()
    return result


def servo_record(problem: ServoProblem, solution: ServoSolution, x: ServoParameters, steps: int) -> Content:
    """Return for config.json: delay [s], errors [rad, m], and by joint kp and the ratios to it with intervals of 95 %.

    determined: whether an interval is narrow enough to be of use.
    """
    return {
        "delay": {"value": x.delay, "half": solution.quantile * float(solution.covariance[-1, -1].sqrt())},
        "rms": problem.residual(x).square().mean(dim=(0, 1)).sqrt().tolist(),
        "steps": steps,
        "joints": _joint_records(problem, solution),
    }


def _joint_records(problem: ServoProblem, solution: ServoSolution) -> list[Content]:
    model, records = problem.model, []
    values = ratios_with_deviations(problem, solution)
    dead_zones = problem.rows.row(DEAD_ZONE) * model.n + torch.arange(model.n)
    distinct = identifiable(solution.windows, solution.precision, dead_zones).tolist()
    for joint, name in enumerate(model.joint_names):
        kp = {"value": float(model.kp[joint].detach()), "known": not float(model.servo.trained[joint])}
        record: Content = {"joint": name, "kp": kp}
        for ratio, (of_joints, deviations) in values.items():
            value = float(of_joints[joint])
            if ratio == "dead_zone" and not value:  # a law that this joint has not
                continue
            half = solution.quantile * math.hypot(TUNING.law_deviation, float(deviations[joint]))
            factor = math.exp(min(half, 50.0))  # which is open by far, and does not overflow
            # dry friction and dead zone each by itself, while their sum, the static error, is determined anyway
            determined = factor < TUNING.open_factor and (
                distinct[joint] or ratio not in ("dry", "dead_zone")
            )
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
    """Return what a fit determined, from `servo_record`; None of a fit that is not over, or of no servos."""
    if record is None:
        return None
    listing = _listing(record)
    delay = f"{1000 * record['delay']['value']:.1f} ms, +- {1000 * record['delay']['half']:.1f} ms"
    errors = ", ".join(number(1000 * rms) for rms in record["rms"])
    undetermined = _undetermined(record)
    text = f"delay {delay}\nerrors on training windows, RMS by joint: {errors} mrad\n{listing.text()}\n{undetermined}"
    listing = replace(listing, note=f"{listing.note} {undetermined}.")
    return FitSummary(text, listing, (delay, "delay of the commands"))


def _listing(record: Content) -> Listing:
    """Return by joint kp, and the ratios to it with intervals; half dead zones too, where a joint has one."""
    columns = [ratio for ratio in RATIOS if any(ratio in joint for joint in record["joints"])]
    rows = []
    for joint in record["joints"]:
        cells = [_shown(joint.get(column)) for column in columns]
        rows.append((joint["joint"], number(joint["kp"]["value"]), *cells))
    head = ("joint", "kp [Nm/rad]", *("{} [{}]".format(*RATIOS[column]) for column in columns))
    return Listing("Servos", head, tuple(rows), f"All columns but kp are {ABOUT}.")


def _undetermined(record: Content) -> str:
    """Return what the logs leave open, dead zones apart."""
    names = []
    for joint in record["joints"]:
        for ratio, (label, _) in RATIOS.items():
            if ratio != "dead_zone" and not joint[ratio]["determined"]:
                names.append(f"{label} of {joint['joint']}")
    if not names:
        return "All ratios are determined"
    return f"Not determined by these logs: {', '.join(names)}"


def _shown(interval: Content | None) -> str:
    if interval is None:
        return "none"
    if not interval["determined"]:
        return "open"
    return f"{number(interval['value'])} +- {100 * (interval['high'] / interval['value'] - 1):.2g} %"
