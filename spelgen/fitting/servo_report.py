"""What logs of commanded positions determine, after a fit: ratios to kp, with intervals, and what they leave open."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from scipy.special import stdtrit

from spelgen.fitting.servo_fit import ServoSolution
from spelgen.fitting.servo_intervals import covariance
from spelgen.fitting.servo_laws import told_apart
from spelgen.fitting.servo_problem import sliding_friction
from spelgen.fitting.servo_weights import DEAD_ZONE
from spelgen.listing import Listing, number

SURE = 0.975  # quantile of an interval of 95 %, of Student's t: windows are few
LAWS = 0.015  # relative deviation of ratios by what friction's laws are not: benchmarks/servo_recovery.py
OPEN = 1.25  # what may be larger by such a factor within its interval is not determined
UNITS = {"kd": "s", "armature": "s^2", "dry": "rad, m", "lost": "rad, m"}
"""What is told in ratio to kp, and the ratio's unit; dry: friction of a joint that slides, over what it slid; lost:
dry and half the dead zone, together."""
ABOUT = (
    "divided by kp, +- half an interval of 95 %: logs of positions tell no more. kp itself rests on the URDF's masses, "
    "where it is not known. kd stands for kd and viscous friction, which such logs cannot tell apart. dry: friction of "
    "a joint that slides, over what it slid, open where it and a dead zone look alike, as without gravity; lost: both "
    "together, dry/kp and half the dead zone"
)


def servo_record(model: Any, solution: ServoSolution) -> dict[str, Any]:
    """For config.json: delay [s], errors, and by joint kp, and the ratios to it with intervals of 95 %."""
    unsure = covariance(solution.normal, solution.precision, solution.halved)
    sure = _sure(solution)
    return {
        "delay": {"value": float(model.delay), "half": sure * float(unsure[-1, -1].sqrt())},
        "rms": solution.rms.tolist(),
        "steps": solution.steps,
        "joints": _joints(model, solution, unsure),
    }


def _sure(solution: ServoSolution) -> float:
    """How many standard deviations half an interval is."""
    return float(stdtrit(max(1, len(solution.normal.matrix) - 1), SURE))


def _joints(model: Any, solution: ServoSolution, unsure: torch.Tensor) -> list[dict[str, Any]]:
    """By joint, with the covariance of all unknowns (k, k)."""
    sure = _sure(solution)
    slid, joints = _dry(model, solution), []
    places = solution.names.index((DEAD_ZONE, 0)) * model.n + torch.arange(model.n)
    apart = told_apart(solution.normal, solution.precision, places)
    for joint, name in enumerate(model.facts.joints):
        about: dict[str, Any] = {"joint": name}
        known = not float(model.servo.trained[joint])
        about["kp"] = {"value": float(model.kp[joint].detach()), "known": known}
        for what, (value, slopes) in _told(model, slid, joint).items():
            direction = torch.zeros(len(unsure)).double()
            for weight, slope in slopes.items():
                direction[solution.names.index((weight, 0)) * model.n + joint] = slope / value
            half = sure * math.hypot(LAWS, float((direction @ unsure @ direction).clamp(min=0).sqrt()))
            about[what] = {"unit": UNITS.get(what, "rad, m"), **_interval(value, half)}
        for what in {"dry", "dead_zone"} & about.keys():
            about[what]["determined"] &= bool(apart[joint])
        joints.append(about)
    return joints


def _told(
    model: Any, slid: tuple[torch.Tensor, dict[str, torch.Tensor]], joint: int
) -> dict[str, tuple[float, dict[str, float]]]:
    """What is told of a joint: its value, and its slopes by weights, which but for dead zones are logarithms."""
    kp, kd, armature, zone = (
        float(x[joint].detach()) for x in (model.kp, model.kd, model.armature, model.servo.dead_zone)
    )
    dry, by_kp = float(slid[0][joint]) / kp, -float(model.servo.trained[joint])
    slopes = {name: float(x[joint]) / kp for name, x in slid[1].items()} | {"servo.raw_kp": by_kp * dry}
    found = {
        "kd": (kd / kp, {"servo.raw_kd": kd / kp, "servo.raw_kp": by_kp * kd / kp}),
        "armature": (
            armature / kp,
            {"rotors.raw": armature / kp, "servo.raw_kp": by_kp * armature / kp},
        ),
        "dry": (dry, slopes),
        "lost": (dry + zone, slopes | {DEAD_ZONE: 1.0}),
    }
    return found | ({"dead_zone": (zone, {DEAD_ZONE: 1.0})} if zone else {})


def _dry(model: Any, solution: ServoSolution) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
    """Dry friction of each joint, (n,) [Nm, N], what it takes over what the joint went, and its slopes by weights."""
    friction = model.friction
    raw = dict(friction.named_parameters())
    with torch.enable_grad():
        dry = sliding_friction(friction, solution.qd, solution.gravity)
        # of a joint the weights of that joint alone
        slopes = torch.autograd.grad(dry.sum(), [*raw.values()], allow_unused=True)
    found = {f"friction.{name}": x for name, x in zip(raw, slopes, strict=True) if x is not None}
    return dry.detach(), found


def _interval(value: float, half: float) -> dict[str, Any]:
    factor = math.exp(min(half, 50.0))
    return {"value": value, "low": value / factor, "high": value * factor, "determined": factor < OPEN}


def servo_text(record: Mapping[str, Any]) -> str:
    """For a terminal: delay, ratios with intervals, and what the logs left open."""
    errors = ", ".join(number(1000 * x) for x in record["rms"])
    told = [f"delay {delay_text(record)}", f"errors on training windows, RMS by joint: {errors} mrad"]
    zones = [f"{x['joint']} {_shown(x['dead_zone'])}" for x in record["joints"] if "dead_zone" in x]
    dead = [f"half dead zones [rad, m]: {', '.join(zones)}"] if zones else []
    return "\n".join([*told, servo_listing(record).text(), *dead, open_text(record)])


def delay_text(record: Mapping[str, Any]) -> str:
    """With its interval."""
    delay = record["delay"]
    return f"{1000 * delay['value']:.1f} ms, +- {1000 * delay['half']:.1f} ms"


def servo_listing(record: Mapping[str, Any], *, zones: bool = False) -> Listing:
    """By joint kp, and the ratios to it with intervals. zones: half dead zones too."""
    rows = []
    for each in record["joints"]:
        row = [each["joint"], number(each["kp"]["value"]), *(_shown(each[what]) for what in UNITS)]
        rows.append(
            (*row, _shown(each["dead_zone"]) if "dead_zone" in each else "none") if zones else (*row,)
        )
    head = ["joint", "kp [Nm/rad]", *(f"{_label(what)} [{unit}]" for what, unit in UNITS.items())]
    head += ["half dead zone [rad, m]"] if zones else []
    return Listing("Servos", tuple(head), tuple(rows), f"Ratios are {ABOUT}.")


def open_text(record: Mapping[str, Any]) -> str:
    """What the logs leave open."""
    left = undetermined(record)
    return f"not determined by these logs: {', '.join(left)}" if left else "all of these are determined"


def foreseen(model: Any, solution: ServoSolution) -> dict[str, list[str]]:
    """Before a fit, by `ServoRounds.foreseen`: what logs will tell in ratio to kp, and what they leave open."""
    whole = solution.normal.matrix.sum(dim=0) + torch.diag(solution.precision)
    record = {"joints": _joints(model, solution, torch.linalg.inv(whole))}
    left = undetermined(record)
    every = [f"{_label(what)} of {each['joint']}" for each in record["joints"] for what in UNITS]
    return {"determined": [x for x in every if x not in left], "open": left}


def foreseen_text(model: Any, names: Mapping[str, Sequence[str]]) -> str:
    """In a sentence."""
    known = bool((model.servo.trained == 0).any())
    found, left = (", ".join(names[x]) or "nothing" for x in ("determined", "open"))
    scale = (
        "kp is known of one joint at least, which tells masses"
        if known
        else "kp and masses are known in ratio alone, unless one kp, mass or load is: kp rests on the URDF's masses"
    )
    return f"by the rank of what they show, these logs determine {found}; they leave open {left}; {scale}"


def undetermined(record: Mapping[str, Any]) -> list[str]:
    """What the logs left as unsure as it was."""
    return [
        f"{_label(what)} of {each['joint']}"
        for each in record["joints"]
        for what in UNITS
        if not each[what]["determined"]
    ]


def _label(what: str) -> str:
    return what if what == "lost" else f"{what}/kp"


def _shown(interval: Mapping[str, Any]) -> str:
    if not interval["determined"]:
        return "open"
    return f"{number(interval['value'])} +- {100 * (interval['high'] / interval['value'] - 1):.2g} %"
