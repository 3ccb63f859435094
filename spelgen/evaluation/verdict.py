"""An evaluation in words: good enough for what, where it fails, and what to record next."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from operator import itemgetter
from typing import TYPE_CHECKING, Any

import numpy as np

from spelgen.baselines.names import CONSTANT_VELOCITY, MODEL, URDF_WITH_DRIVES, observed
from spelgen.errors import shortened
from spelgen.labels import listed, share, thousandths
from spelgen.listing import number
from spelgen.settings.tuning.evaluation import EvaluationTuning

if TYPE_CHECKING:
    from spelgen.evaluation.horizons import StateErrors
    from spelgen.evaluation.results import Results

TUNING = EvaluationTuning()
SEEN = "tested-on-training-data"
STANDSTILL = "near standstill"
EXCITE = "(as spelgen excite proposes)"
TORQUE_USES: tuple[tuple[float, Sequence[str], Sequence[str]], ...] = (
    (TUNING.explained_for_contacts, ["feed-forward control", "contact detection"], []),
    (TUNING.explained_for_feed_forward, ["feed-forward control"], ["contact detection"]),
    (TUNING.explained_for_gravity, ["gravity compensation"], ["feed-forward control"]),
    (-math.inf, [], ["control"]),
)
"""By the least part of a torque's variance that is explained: what the model is good enough for, and what not."""
Limits = Sequence[tuple[float, float] | None]
"""Lowest and highest position of each joint; None: it has no limits."""


@dataclass(frozen=True)
class Verdict:
    """sentence: good enough for what, where it fails, what to record next. because: the figures behind it."""

    sentence: str
    because: str


@dataclass
class _Uses:
    """What a model is good enough for, what not, and the figures that say so."""

    good: list[str] = field(default_factory=list)
    bad: list[str] = field(default_factory=list)
    proofs: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class _Failure:
    """Where a model fails most: a joint, when it does, and the figure that says so."""

    joint: str = ""
    when: str = ""
    proof: str = ""


def verdict(results: Results, identified: Mapping[str, Any] | None = None, limits: Limits = ()) -> Verdict:
    """Judge an evaluation. identified: least_squares.json, of the training logs. limits: of the joints."""
    uses = _Uses()
    _judge_torques(results, uses)
    _judge_motion(results, uses)
    _judge_replays(results, uses)
    if not uses.proofs:
        return Verdict("No verdict: no horizon and no torque was evaluated.", "")
    worst = _worst_joint(results)
    recommendations = _recommendations(results, identified or {}, limits, worst)
    sentence = "Not accurate enough yet"
    if uses.good:
        sentence = f"Good enough for {listed(uses.good)}"
    if any(diagnostic.code == SEEN for diagnostic in results.diagnostics):
        sentence = sentence[0].lower() + sentence[1:]
        sentence = f"Evaluated on training logs: {sentence}"
    if uses.good and uses.bad:
        sentence += f", not for {listed(uses.bad)}"
    details = []
    if worst.joint:
        details.append(f"worst at {worst.joint}{worst.when}")
    if recommendations:
        details.append(f"next, record {next(iter(recommendations))}")
    because = []
    for detail in details:
        longer = f"{sentence}; {detail}"
        # a headline is read at a glance
        if len(longer.split()) <= TUNING.headline:
            sentence = longer
        else:
            because.append(f"{detail[0].upper()}{detail[1:]}.")
    because += [
        f"The model {listed(uses.proofs)}.",
        _constant_velocity(results),
        worst.proof,
        _better_baselines(results),
    ]
    because += [f"{reason}." for reason in recommendations.values()]
    return Verdict(f"{sentence}.", " ".join(statement for statement in because if statement))


def _judge_torques(results: Results, uses: _Uses) -> None:
    """Judge by the joint whose torque is explained least: a mean hides it."""
    torque = results.torque.get(MODEL)
    if torque is None or torque.mean_nmse is None:
        return
    worst = _worst_torque(results)
    unexplained = torque.mean_nmse if worst is None else worst[1]
    explained = 1 - unexplained  # coefficient of determination
    for least, good, bad in TORQUE_USES:
        if explained >= least:
            uses.good += good
            uses.bad += bad
            break
    proof = f"explains {_explained(torque.mean_nmse)} of the variance of the torques"
    if worst is not None and _explained(worst[1]) != _explained(torque.mean_nmse):
        proof += f" ({_explained(worst[1])} at {worst[0]})"
    uses.proofs.append(proof)


def _explained(nmse: float) -> str:
    return share(1 - nmse) if nmse < 1 else "none"


def _worst_torque(results: Results) -> tuple[str, float] | None:
    """Return the joint of the model's largest nMSE, and this; of joints whose torque is not logged in coarse steps."""
    torque = results.torque.get(MODEL)
    errors: dict[str, float] = {}
    if torque is not None:
        for joint, error in zip(results.joints, torque.joint_nmse, strict=False):
            if error is not None and joint not in results.torque_steps:
                errors[joint] = error
    return max(errors.items(), key=itemgetter(1), default=None)


def _judge_motion(results: Results, uses: _Uses) -> None:
    # a long horizon may blow up where a short one tells something
    finite = [x for x in results.horizons if x.errors[MODEL].mean_relative_rms is not None]
    if not finite:
        if results.horizons:
            uses.bad.append("simulation")
            uses.proofs.append("predicts no finite motion")
        return
    last = finite[-1]
    error = _relative(last.errors[MODEL])
    holding = _relative(last.errors.get(observed(MODEL)))
    if error <= TUNING.close_prediction:
        uses.good.append(f"simulation {last.name} ahead")
    elif error <= TUNING.rough_prediction:
        uses.good.append(f"rough simulation {last.name} ahead")
    else:
        uses.bad.append(f"simulation {last.name} ahead")
        if holding <= TUNING.rough_prediction:
            uses.good.append(f"prediction {last.name} ahead with a momentum observer")
    proof = f"is off by {share(error, 'the motion')} after {last.name}"
    tip = last.errors[MODEL].tip_mm
    if tip is not None:
        proof += f", {number(tip)} mm at the tip"
    uses.proofs.append(proof)


def _judge_replays(results: Results, uses: _Uses) -> None:
    if not results.replays:
        return
    replay = results.replays[0]
    model_error = replay.errors[MODEL].mean  # of whole logs: windows forgive what drifts
    if model_error == min(errors.mean for errors in replay.errors.values()):
        uses.good.append("simulation from commands")
    else:
        uses.bad.append("simulation from commands")
    unit = thousandths(results.joint_types)
    uses.proofs.append(
        f"misses {1000 * model_error:.3g} {unit} of the positions that follow commands, {replay.name}"
    )


def _relative(errors: StateErrors | None) -> float:
    """Return the mean error relative to the motion; infinite where it is not known."""
    if errors is None or errors.mean_relative_rms is None:
        return math.inf
    return errors.mean_relative_rms


def _constant_velocity(results: Results) -> str:
    """Say at which times ahead a constant velocity is better than the model, with an observer and without."""
    times = []
    for horizon in results.horizons:
        model_error = min(_relative(horizon.errors.get(name)) for name in (MODEL, observed(MODEL)))
        if _relative(horizon.errors.get(CONSTANT_VELOCITY)) < model_error:
            times.append(horizon.name)
    if not times:
        return ""
    return (
        f"A constant velocity predicts better {listed(times)} ahead: there, use the model for torques only."
    )


def _better_baselines(results: Results) -> str:
    """Say which other baselines are better, at what."""
    better: dict[str, list[str]] = {}
    errors = {
        f"after {x.name}": {name: _relative(e) for name, e in x.errors.items()} for x in results.horizons
    }
    errors["in torque"] = {name: x.mean_nmse for name, x in results.torque.items() if x.mean_nmse is not None}
    for occasion, by_predictor in errors.items():
        by_predictor.pop(CONSTANT_VELOCITY, None)
        best = min(by_predictor, key=by_predictor.__getitem__, default=MODEL)
        if MODEL in by_predictor and best not in (MODEL, observed(MODEL)):
            better.setdefault(best, []).append(occasion)
    if not better:
        return ""
    drives = [results.horizons[-1].errors.get(URDF_WITH_DRIVES)] if results.horizons else []
    if any(_relative(errors) < TUNING.simulated for errors in drives):
        return f"{URDF_WITH_DRIVES} reproduces these logs: it is the model that simulated them."
    statements = []
    for name, occasions in better.items():
        statements.append(f"{name} is better {listed(occasions)}")
    return f"But {listed(statements)}."


def _worst_joint(results: Results) -> _Failure:
    """Return the joint whose torque is explained least, else the one whose motion is."""
    worst = _worst_torque(results)
    if worst is not None:
        joint, error = worst
        amount = share(math.sqrt(error), "the torque's standard deviation")
        proof = f"At {joint} the torque residual is {amount}."
        return _Failure(joint, _slow_or_fast(results, results.joints.index(joint)), proof)
    if not results.horizons:
        return _Failure()
    last = results.horizons[-1]
    errors = last.errors[MODEL].q_relative_rms
    if not errors or None in errors:
        return _Failure()
    k = int(np.argmax(np.array(errors, dtype=float)))
    amount = share(float(errors[k] or 0), "the motion")
    joint = results.joints[k]
    return _Failure(joint, "", f"At {joint} the error after {last.name} is {amount}.")


def _slow_or_fast(results: Results, k: int) -> str:
    """Return at which speed of joint k the residuals of its torque are larger, where they differ."""
    residuals, speeds = [np.zeros(0)], [np.zeros(0)]
    for trace in results.traces.torques:
        residuals.append(trace.measured[:, k] - trace.predicted[MODEL][:, k])
        speeds.append(np.abs(trace.qd[:, k]))
    residual, speed = np.concatenate(residuals), np.concatenate(speeds)
    slow = speed < TUNING.slow * np.nanmax(speed, initial=0.0)
    # a handful of samples tells no root mean square
    if not 5 < slow.sum() < len(slow) - 5:
        return ""
    size_slow, size_fast = (np.sqrt(np.nanmean(residual[rows] ** 2)) for rows in (slow, ~slow))
    if size_slow > TUNING.uneven * size_fast:
        return f" {STANDSTILL}"
    return " at speed" if size_fast > TUNING.uneven * size_slow else ""


def _recommendations(
    results: Results, identified: Mapping[str, Any], limits: Limits, worst: _Failure
) -> dict[str, str]:
    """Return which motions to record, the most useful first, and why."""
    recommendations = {}
    trained = identified.get("coverage") or {}
    unseen = identified.get("unseen_directions")
    if unseen:
        reason = f"The training logs do not excite {unseen} directions of the base parameters"
        recommendations[f"a richer motion {EXCITE}"] = reason
    outside = _outside(trained, results.traces.coverage, results.joints)
    if outside:
        reason = f"The test logs exceed the range of the training logs: {shortened(outside, 3)}"
        recommendations[f"motion with the {outside[0]} that the test logs have"] = reason
    if worst.when.endswith(STANDSTILL):
        recommendations[f"slow reversals of {worst.joint}"] = "Dry friction is learned from slow reversals"
    fractions = _range_fractions(trained, results.joints, limits)
    if fractions:
        joint = min(fractions, key=fractions.__getitem__)
        if fractions[joint] < TUNING.narrow_range:
            reason = f"{joint} has moved over {share(fractions[joint], 'its range')}"
            recommendations[f"wider motion of {joint}"] = reason
    base = identified.get("base_parameters", ())
    weak = [parameter for parameter in base if parameter["determined"] in ("weak", "may be zero")]
    if weak:
        reason = f"{len(weak)} of {len(base)} base parameters are not significantly different from zero"
        recommendations[f"faster motion of all joints together {EXCITE}"] = reason
    return recommendations


def _range_fractions(trained: Mapping[str, Any], joints: Sequence[str], limits: Limits) -> dict[str, float]:
    """Return the fraction of its range that each joint has moved over, a turn at most."""
    fractions = {}
    for name, covered, bound in zip(joints, trained.get("q", ()), limits, strict=False):
        if bound is not None and bound[1] > bound[0]:
            # a turn shows all of a joint that can go on turning
            room = min(bound[1] - bound[0], 2 * math.pi)
            fractions[name] = (covered["high"] - covered["low"]) / room
    return fractions


def _outside(trained: Mapping[str, Any], tested: Mapping[str, Any], joints: Sequence[str]) -> list[str]:
    """Return where the test logs go beyond the training logs by a tenth of these."""
    exceeded = []
    for quantity, word in (("q", "positions"), ("qd", "velocities")):
        ranges = zip(joints, trained.get(quantity, ()), tested.get(quantity, ()), strict=False)
        for name, inner, outer in ranges:
            room = 0.1 * (inner["high"] - inner["low"])
            if outer["low"] < inner["low"] - room or outer["high"] > inner["high"] + room:
                exceeded.append(f"{word} of {name}")
    return exceeded
