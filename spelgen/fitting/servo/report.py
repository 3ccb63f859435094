"""Report what logs of commanded positions determine: ratios to kp with intervals, and what they leave open."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, TypedDict

import torch
from scipy.special import stdtrit

from spelgen.fitting.functional_model import FunctionalModel
from spelgen.fitting.levenberg_marquardt import NormalEquations
from spelgen.fitting.objective import FitSummary
from spelgen.fitting.servo.intervals import TUNING, by_stretch, covariance, identifiable
from spelgen.fitting.servo.laws import sliding_friction
from spelgen.fitting.servo.parameters import DEAD_ZONE, ServoParameters
from spelgen.fitting.servo.problem import ServoProblem
from spelgen.listing import Listing, number

if TYPE_CHECKING:
    from spelgen.emission.loading import EmittedModel

QUANTILE = 0.975  # of an interval of 95 %, of Student's t: windows are few
UNITS = {"kd": "s", "armature": "s^2", "dry": "rad, m", "static_error": "rad, m"}
"""The ratios to kp, and their units; dry: friction of a joint that slides, over what it slid; static_error: dry and
half the dead zone, together."""
LABELS = {
    "kd": "kd/kp",
    "armature": "armature/kp",
    "dry": "dry/kp",
    "static_error": "static error",
    "dead_zone": "half dead zone",
}
ABOUT = (
    "divided by kp, with half a 95 % interval. kp itself is scaled by the URDF's masses, unless it is known. kd is the "
    "sum of kd and viscous friction, which such logs do not distinguish. dry: dry friction; open where it cannot be "
    "distinguished from a dead zone, as without gravity. static error: the sum of dry/kp and half the dead zone"
)


class Interval(TypedDict):
    """Hold a ratio with its interval of 95 %; determined: whether this is narrow enough to be of use."""

    unit: str
    value: float
    low: float
    high: float
    determined: bool


JointRecord = dict[str, Any]
"""The joint's name, its kp, and an `Interval` for each ratio."""
ServoRecord = Mapping[str, Any]
"""What config.json holds of a fit of servos."""


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
    free, errors = replace(x, active=torch.ones_like(x.active)), problem.residuals(x)
    windows = problem.window_equations(free, errors)
    windows = by_stretch(windows, problem.windows.stretches(TUNING.logs, TUNING.stretches))
    precision = problem.rows.precision(free)
    step = problem.with_prior(windows, x).step()
    # where the fit ends, the slopes of all windows and of the prior add up to nothing
    windows = windows._replace(descent=windows.descent - windows.curvature @ step)
    end = x.moved(step)
    # where joints just slip, errors are far from linear in the parameters
    if problem.cost(end, problem.residuals(end)) > problem.cost(x, errors):
        end = x
    return end, ServoSolution(windows, precision, covariance(windows, precision, step))


def ratios(model: EmittedModel, qd: torch.Tensor, gravity: torch.Tensor) -> dict[str, torch.Tensor]:
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
    functional = FunctionalModel(problem.model)
    values = functional.under(tensors, lambda model: ratios(model, qd, gravity))
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


def joint_records(problem: ServoProblem, solution: ServoSolution) -> list[JointRecord]:
    """Return by joint kp, and the ratios to it with intervals."""
    model, joints = problem.model, []
    values = ratios_with_deviations(problem, solution)
    dead_zones = problem.rows.row(DEAD_ZONE) * model.n + torch.arange(model.n)
    distinct = identifiable(solution.windows, solution.precision, dead_zones).tolist()
    for joint, name in enumerate(model.facts.joints):
        known = not float(model.servo.trained[joint])
        record: JointRecord = {
            "joint": name,
            "kp": {"value": float(model.kp[joint].detach()), "known": known},
        }
        for ratio, (value, deviation) in values.items():
            if ratio == "dead_zone" and not value[joint]:  # a law that this joint has not
                continue
            half = solution.quantile * math.hypot(TUNING.law_deviation, float(deviation[joint]))
            interval = _interval(UNITS.get(ratio, "rad, m"), float(value[joint]), half)
            # each by itself, while their sum, the static error, is determined anyway
            if ratio in ("dry", "dead_zone"):
                interval["determined"] &= distinct[joint]
            record[ratio] = interval
        joints.append(record)
    return joints


def _interval(unit: str, value: float, half: float) -> Interval:
    """Return that of a logarithm's half width."""
    factor = math.exp(min(half, 50.0))  # which is open by far, and does not overflow
    determined = factor < TUNING.open_factor
    return Interval(unit=unit, value=value, low=value / factor, high=value * factor, determined=determined)


def servo_record(
    problem: ServoProblem, solution: ServoSolution, x: ServoParameters, steps: int
) -> dict[str, Any]:
    """Return for config.json: delay [s], errors [rad, m], and by joint kp and the ratios to it with intervals."""
    half = solution.quantile * float(solution.covariance[-1, -1].sqrt())
    return {
        "delay": {"value": x.delay, "half": half},
        "rms": problem.residuals(x).square().mean(dim=(0, 1)).sqrt().tolist(),
        "steps": steps,
        "joints": joint_records(problem, solution),
    }


def servo_summary(config: ServoRecord) -> FitSummary | None:
    """Return what a fit determined; config: what config.json holds, of a fit that is over."""
    if "servo" not in config:
        return None
    record = config["servo"]
    listing = servo_listing(record)
    listing = replace(listing, note=f"{listing.note} {open_text(record)}.")
    return FitSummary(servo_text(record), listing, (delay_text(record), "delay of the commands"))


def servo_text(record: ServoRecord) -> str:
    """Return for a terminal: delay, ratios with intervals, and what the logs left open."""
    errors = ", ".join(number(1000 * rms) for rms in record["rms"])
    return "\n".join(
        [
            f"delay {delay_text(record)}",
            f"errors on training windows, RMS by joint: {errors} mrad",
            servo_listing(record).text(),
            open_text(record),
        ]
    )


def delay_text(record: ServoRecord) -> str:
    """Return the delay with its interval."""
    delay = record["delay"]
    return f"{1000 * delay['value']:.1f} ms, +- {1000 * delay['half']:.1f} ms"


def servo_listing(record: ServoRecord) -> Listing:
    """Return by joint kp, and the ratios to it with intervals; half dead zones too, where a joint has one."""
    columns = [*UNITS]
    if any("dead_zone" in joint for joint in record["joints"]):
        columns.append("dead_zone")
    rows = []
    for joint in record["joints"]:
        cells = [_shown(joint.get(column)) for column in columns]
        rows.append((joint["joint"], number(joint["kp"]["value"]), *cells))
    head = ["joint", "kp [Nm/rad]"]
    head += [f"{LABELS[column]} [{UNITS.get(column, 'rad, m')}]" for column in columns]
    return Listing("Servos", tuple(head), tuple(rows), f"All columns but kp are {ABOUT}.")


def open_text(record: ServoRecord) -> str:
    """Return what the logs leave open."""
    names = []
    for joint in record["joints"]:
        left = (ratio for ratio in UNITS if not joint[ratio]["determined"])
        names += [f"{LABELS[ratio]} of {joint['joint']}" for ratio in left]
    if not names:
        return "All ratios are determined"
    return f"Not determined by these logs: {', '.join(names)}"


def _shown(interval: Interval | None) -> str:
    if interval is None:
        return "none"
    if not interval["determined"]:
        return "open"
    return f"{number(interval['value'])} +- {100 * (interval['high'] / interval['value'] - 1):.2g} %"
