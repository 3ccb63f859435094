"""What an evaluation comes to in words: good enough for what, where it fails, and what to record next."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from spelgen.baselines.names import MODEL
from spelgen.labels import listed, thousandths
from spelgen.listing import number

# part of the torque's variance that is explained -> what that is good for, and what not
CONTROL = (
    (0.99, "feed-forward control, telling contacts from its own error", ""),
    (0.95, "feed-forward control", "telling contacts from its own error"),
    (0.8, "gravity compensation", "feed-forward control"),
    (-math.inf, "", "control"),
)
CLOSE, ROUGH = 0.1, 0.3  # relative RMS up to which a prediction is close, or rough
SEEN = "tested-on-training-data"
STANDSTILL = "near standstill"
SLOW = 0.1  # of a joint's largest velocity
UNEVEN = 1.4  # ratio of errors that is worth a word
NARROW = 0.5  # part of a joint's range below which its logs are narrow


@dataclass(frozen=True)
class Verdict:
    """sentence: good enough for what, where it fails, what to record next. because: the figures behind it."""

    sentence: str
    because: str


def verdict(
    evaluation: Mapping[str, Any],
    identified: Mapping[str, Any] | None = None,
    limits: Sequence[tuple[float, float] | None] = (),
) -> Verdict:
    """Of evaluation.json, beside what least squares found of the training logs; limits: of the joints."""
    good, bad, proofs = _uses(evaluation)
    if not proofs:
        return Verdict("Nothing to judge by: no horizon and no torque was evaluated.", "")
    place, worst = _worst(evaluation)
    known = any(x.get("code") == SEEN for x in evaluation.get("diagnostics", ()))
    told = f"Good enough for {listed(good)}" if good else "Not good enough yet to rely on"
    told = (
        f"Judged on logs that it was trained on, which proves little: {told[0].lower()}{told[1:]}"
        if known
        else told
    )
    told += f", not for {listed(bad)}" if bad and good else ""
    told += f"; worst at {place}" if place else ""
    wishes = _wishes(evaluation, identified, limits, place)
    told += f"; next, record {wishes[0][0]}" if wishes else ""
    because = [f"It {listed(proofs)}.", worst, _beaten(evaluation), *(f"{x[1]}." for x in wishes)]
    return Verdict(f"{told}.", " ".join(x for x in because if x))


def _uses(evaluation: Mapping[str, Any]) -> tuple[list[str], list[str], list[str]]:
    good, bad, proofs = [], [], []
    torque = evaluation["torque"].get(MODEL)
    nmse = torque["mean_nmse"] if torque else None
    if nmse is not None:
        _, use, missing = next(row for row in CONTROL if 1 - nmse >= row[0])
        good += use.split(", ") if use else []
        bad += [missing] if missing else []
        part = 1 - nmse
        amount = "none" if part <= 0 else f"{_percent(part)}"
        proofs.append(f"explains {amount} of the variance of the torques")
    simulated = [(x["name"], x["errors"][MODEL]) for x in evaluation["horizons"]]
    horizons = [(name, errors["mean_relative_rms"], errors["tip_mm"]) for name, errors in simulated]
    known = [x for x in horizons if x[1] is not None]
    if known:
        name, error, tip = known[-1]
        if error <= ROUGH:
            good.append(f"{'simulation' if error <= CLOSE else 'rough simulation'} {name} ahead")
        else:
            bad.append(f"simulation {name} ahead")
        away = "" if tip is None else f", {number(tip)} mm at the tip"
        proofs.append(
            f"misses {_percent(error)} of the motion after {name}{away}"
            if error <= 1
            else f"is off by {error:.3g} times the motion after {name}{away}"
        )
    replay = next(iter(evaluation.get("replays") or ()), None)
    if replay:
        errors = {name: each["mean"] for name, each in replay["errors"].items()}
        good += ["simulation from commands"] if errors[MODEL] == min(errors.values()) else []
        bad += [] if good else ["simulation from commands"]
        proofs.append(
            f"misses {1000 * errors[MODEL]:.3g} {thousandths(evaluation.get('joint_types', ()))} of the positions that "
            f"follow commands, {replay['name']}"
        )
    elif horizons and not known:
        bad.append("simulation")
        proofs.append("predicts nothing that stays finite")
    return good, bad, proofs


def _worst(evaluation: Mapping[str, Any]) -> tuple[str, str]:
    """The joint that fails most, slowly or fast, and the figure that tells."""
    joints, traces = evaluation["joints"], evaluation.get("traces") or {}
    left = _residuals(traces)
    if left:
        ratios = [float(np.sqrt(np.nanmean(r**2)) / (np.nanstd(m) or math.inf)) for r, m, _ in left]
        k = int(np.nanargmax(ratios))
        residual, _, qd = left[k]
        slow = np.abs(qd) < SLOW * np.nanmax(np.abs(qd))
        when = ""
        if 5 < slow.sum() < len(slow) - 5:
            size = [float(np.sqrt(np.nanmean(residual[x] ** 2))) for x in (slow, ~slow)]
            when = f" {STANDSTILL}" if size[0] > UNEVEN * size[1] else ""
            when = " at speed" if size[1] > UNEVEN * size[0] else when
        return (
            f"{joints[k]}{when}",
            f"At {joints[k]} {_percent(ratios[k])} of the torque's variation is left.",
        )
    horizon = next(reversed(evaluation["horizons"]), None)
    sizes = horizon["errors"][MODEL]["q_relative_rms"] if horizon else []
    if horizon is None or not sizes or None in sizes:
        return "", ""
    k = int(np.argmax(sizes))
    return joints[k], f"At {joints[k]} it misses {_percent(sizes[k])} of the motion after {horizon['name']}."


def _beaten(evaluation: Mapping[str, Any]) -> str:
    """Which baselines are better, at what."""
    lost: dict[str, list[str]] = {}
    for horizon in evaluation["horizons"]:
        errors = {name: x["mean_relative_rms"] for name, x in horizon["errors"].items()}
        _note_better(errors, f"after {horizon['name']}", lost)
    torque = {name: x["mean_nmse"] for name, x in evaluation["torque"].items()}
    _note_better(torque, "in torque", lost)
    told = [f"{name} is better {listed(where)}" for name, where in lost.items()]
    return f"But {listed(told)}." if told else ""


def _note_better(errors: Mapping[str, float | None], where: str, lost: dict[str, list[str]]) -> None:
    known = {name: x for name, x in errors.items() if x is not None}
    best = min(known, key=known.__getitem__, default=MODEL)
    if best != MODEL and MODEL in errors:
        lost.setdefault(best, []).append(where)


def _wishes(
    evaluation: Mapping[str, Any],
    identified: Mapping[str, Any] | None,
    limits: Sequence[tuple[float, float] | None],
    worst: str,
) -> list[tuple[str, str]]:
    """What to record, the most useful first, and why."""
    joints, found = evaluation["joints"], []
    seen = (identified or {}).get("coverage") or {}
    outside = _outside(seen, (evaluation.get("traces") or {}).get("coverage") or {}, joints)
    if identified and identified.get("unseen_directions"):
        why = f"The training logs say nothing in {identified['unseen_directions']} directions of the base parameters"
        found.append(("a richer motion (as spelgen excite proposes)", why))
    if outside:
        why = f"The test logs go where the training logs do not: {_shortened(outside)}"
        found.append((f"motion with the {outside[0]} that the test logs have", why))
    if worst.endswith(STANDSTILL):
        joint = worst.removesuffix(f" {STANDSTILL}")
        found.append((f"slow reversals of {joint}", "Dry friction is learned from slow reversals"))
    narrow = _narrow(seen, joints, limits)
    if narrow:
        found.append((f"wider motion of {narrow[0]}", f"{narrow[0]} has moved over {narrow[1]} of its range"))
    base = (identified or {}).get("base_parameters", ())
    open_ = [each["name"] for each in base if each["determined"] in ("weak", "may be zero")]
    if open_:
        why = f"{len(open_)} of {len(base)} base parameters can hardly be told from zero by these logs"
        found.append(("faster motion of all joints together (as spelgen excite proposes)", why))
    return found


def _narrow(
    seen: Mapping[str, Any], joints: Sequence[str], limits: Sequence[tuple[float, float] | None]
) -> tuple[str, str] | None:
    """The joint that uses least of its range, where that is little, and how much."""
    parts = {}
    for name, found, bound in zip(joints, seen.get("q", ()), limits, strict=False):
        if bound is not None and bound[1] > bound[0]:
            parts[name] = (found["high"] - found["low"]) / min(bound[1] - bound[0], 2 * math.pi)
    least = min(parts, key=parts.__getitem__, default="")
    return (least, _percent(parts[least])) if least and parts[least] < NARROW else None


def _outside(seen: Mapping[str, Any], tested: Mapping[str, Any], joints: Sequence[str]) -> list[str]:
    found = []
    for what, word in (("q", "positions"), ("qd", "velocities")):
        for name, own, other in zip(joints, seen.get(what, ()), tested.get(what, ()), strict=False):
            room = 0.1 * (own["high"] - own["low"])
            if other["low"] < own["low"] - room or other["high"] > own["high"] + room:
                found.append(f"{word} of {name}")
    return found


def _residuals(traces: Mapping[str, Any]) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """By joint: residual torque, measured torque and velocity, of all traces."""
    torques = traces.get("torques") or []
    if not torques:
        return []
    columns = [
        np.concatenate([np.array(row(trace), dtype=float) for trace in torques])
        for row in (lambda x: x["measured"], lambda x: x["predicted"][MODEL], lambda x: x["qd"])
    ]
    return [(a - b, a, qd) for a, b, qd in zip(*(x.T for x in columns), strict=True)]


def _shortened(names: Iterable[str]) -> str:
    names = list(names)
    return listed(names) if len(names) <= 4 else f"{', '.join(names[:3])} and {len(names) - 3} more"


def _percent(part: float) -> str:
    return f"{100 * part:.3g} %" if part < 0.99 or part >= 1 else f"{100 * part:.4g} %"
