"""What logs of commanded positions determine, after a fit: ratios to kp, with intervals, and what they leave open."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
from scipy.stats import t as student

from spelgen.fitting.servo_fit import ServoSolution
from spelgen.fitting.servo_intervals import covariance
from spelgen.listing import Listing, number

SURE = 0.975  # quantile of an interval of 95 %, of Student's t: windows are few
LAWS = 0.01  # relative standard deviation of a ratio by what laws of friction are not, see benchmarks/servo_recovery.py
OPEN = 2.0  # what may be larger by such a factor within its interval is not determined
UNITS = {"kd": "s", "armature": "s^2", "dry": "rad, m"}
"""What is told in ratio to kp, and the ratio's unit; dry: friction of a joint that slides, under the usual load."""
ABOUT = (
    "divided by kp, +- half an interval of 95 %: logs of positions tell no more. kp itself rests on the URDF's masses, "
    "where it is not known. dry: friction of a joint that slides under its usual load. kd "
    "stands for kd and viscous friction, which such logs cannot tell apart"
)


def servo_record(model: Any, solution: ServoSolution) -> dict[str, Any]:
    """For config.json: delay [s], errors, and by joint kp, and the ratios to it with intervals of 95 %."""
    n, places = model.n, {name: k for k, (name, _) in enumerate(solution.names)}
    unsure = covariance(solution.normal, solution.precision, solution.halved)
    sure = student.ppf(SURE, max(1, len(solution.normal.matrix) - 1))
    kp = places["servo.raw_kp"]
    joints = []
    for joint, name in enumerate(model.facts.joints):
        trained = float(model.servo.trained[joint])
        about: dict[str, Any] = {"joint": name}
        about["kp"] = {"value": float(model.kp[joint].detach()), "known": not trained}
        for what, parts in _parts(model, solution, joint).items():
            whole = sum(parts.values())
            ratio = [(places[weight], joint, part / whole) for weight, part in parts.items()]
            half = sure * _deviation(unsure, n, [*ratio, (kp, joint, -trained)])
            about[what] = {"unit": UNITS[what], **_interval(whole / about["kp"]["value"], half)}
        joints.append(about)
    return {
        "delay": {"value": float(model.delay), "half": sure * float(unsure[-1, -1].sqrt())},
        "rms": solution.rms.tolist(),
        "steps": solution.steps,
        "joints": joints,
    }


def _parts(model: Any, solution: ServoSolution, joint: int) -> dict[str, dict[str, float]]:
    """What each of `UNITS` is a sum of at a joint [Nm ...], by weight: weights are logarithms of these parts."""
    with torch.no_grad():
        friction = model.dynamics.friction.prepare()
        found = {
            "kd": {"servo.raw_kd": model.kd},
            "armature": {"dynamics.armature.raw": model.armature},
            "dry": {
                "dynamics.friction.raw_coulomb": friction.coulomb,
                "dynamics.friction.raw_load_dependence": friction.load_dependence * solution.gravity,
            },
        }
        return {what: {name: float(x[joint]) for name, x in parts.items()} for what, parts in found.items()}


def _deviation(unsure: torch.Tensor, n: int, terms: list[tuple[int, int, float]]) -> float:
    """The standard deviation of a sum of weights (row, joint, factor), and of laws."""
    direction = torch.zeros(len(unsure)).double()
    for row, joint, factor in terms:
        direction[row * n + joint] = factor
    return math.hypot(LAWS, float((direction @ unsure @ direction).clamp(min=0).sqrt()))


def _interval(value: float, half: float) -> dict[str, Any]:
    factor = math.exp(min(half, 50.0))
    return {"value": value, "low": value / factor, "high": value * factor, "determined": factor < OPEN}


def servo_text(record: Mapping[str, Any]) -> str:
    """For a terminal: delay, ratios with intervals, and what the logs left open."""
    rows = [
        (each["joint"], number(each["kp"]["value"]), *(_shown(each[what]) for what in UNITS))
        for each in record["joints"]
    ]
    head = ("joint", "kp [Nm/rad]", *(f"{what}/kp [{unit}]" for what, unit in UNITS.items()))
    table = Listing("Servos", head, tuple(rows), f"Ratios are {ABOUT}.").text()
    open_ones = undetermined(record)
    left = (
        f"not determined by these logs: {', '.join(open_ones)}"
        if open_ones
        else "all of these are determined"
    )
    delay = record["delay"]
    late = f"delay {1000 * delay['value']:.1f} ms, +- {1000 * delay['half']:.1f} ms"
    errors = ", ".join(number(1000 * x) for x in record["rms"])
    return f"{late}\nerrors on training windows, RMS by joint: {errors} mrad\n{table}\n{left}"


def undetermined(record: Mapping[str, Any]) -> list[str]:
    """What the logs left as unsure as it was."""
    return [
        f"{what}/kp of {each['joint']}"
        for each in record["joints"]
        for what in UNITS
        if not each[what]["determined"]
    ]


def _shown(interval: Mapping[str, Any]) -> str:
    if not interval["determined"]:
        return "open"
    return f"{number(interval['value'])} +- {100 * (interval['high'] / interval['value'] - 1):.2g} %"
