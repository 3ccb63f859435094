"""An evaluation in words: good enough for what, where it fails, and what to record next."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from operator import itemgetter
from typing import Any

import numpy as np

from spelgen.baselines.names import CONSTANT_VELOCITY, MODEL, observed
from spelgen.errors import shortened
from spelgen.evaluation.horizons import StateErrors
from spelgen.evaluation.measurements import Measurements
from spelgen.evaluation.tuning import TUNING
from spelgen.labels import listed, share, thousandths
from spelgen.listing import number

SEEN = "tested-on-training-data"
STANDSTILL = " near standstill"
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


def verdict(
    results: Measurements, identified: Mapping[str, Any] | None = None, limits: Limits = ()
) -> Verdict:
    """Judge an evaluation. identified: least_squares.json, of the training logs. limits: of the joints."""
    uses = _Uses()
    _judge_torques(results, uses)
    _judge_motion(results, uses)
    _judge_replays(results, uses)
    if not uses.proofs:
        return Verdict("No verdict: no horizon and no torque was evaluated.", "")
    sentence = f"Good enough for {listed(uses.good)}" if uses.good else "Not accurate enough yet"
    if any(diagnostic.code == SEEN for diagnostic in results.diagnostics):
        sentence = f"Evaluated on training logs: {sentence[0].lower()}{sentence[1:]}"
    if uses.good and uses.bad:
        sentence += f", not for {listed(uses.bad)}"
    joint, speed, proof = _worst_joint(results)
    recommendations = _recommendations(results, identified or {}, limits, joint, speed)
    details = []
    if joint:
        details.append(f"worst at {joint}{speed}")
    if recommendations:
        details.append(f"next, record {next(iter(recommendations))}")
    because = []
    for detail in details:
        # a headline is read at a glance
        if len(f"{sentence}; {detail}".split()) <= TUNING.headline:
            sentence += f"; {detail}"
        else:
            because.append(f"{detail[0].upper()}{detail[1:]}.")
    because += [f"The model {listed(uses.proofs)}.", proof, *_better_baselines(results)]
    because += recommendations.values()
    return Verdict(f"{sentence}.", " ".join(filter(None, because)))


def _judge_torques(results: Measurements, uses: _Uses) -> None:
    """Judge by the joint whose torque is explained least: a mean hides it."""
    torque = results.torque.get(MODEL)
    if torque is None or torque.mean_nmse is None:
        return
    joint, unexplained = _worst_torque(results)
    if not joint:
        unexplained = torque.mean_nmse
    for threshold, good, bad in TORQUE_USES:
        if 1 - unexplained >= threshold:  # coefficient of determination
            uses.good += good
            uses.bad += bad
            break
    mean, worst = (share(max(0.0, 1 - nmse)) for nmse in (torque.mean_nmse, unexplained))
    proof = f"explains {mean} of the variance of the torques"
    if worst != mean:
        proof += f" ({worst} at {joint})"
    uses.proofs.append(proof)


def _worst_torque(results: Measurements) -> tuple[str, float]:
    """Return the joint of the model's largest nMSE, of those whose torque is not logged in coarse steps, and this."""
    worst = ("", -math.inf)
    if MODEL in results.torque:
        for joint, error in zip(results.joints, results.torque[MODEL].joint_nmse, strict=False):
            if error is not None and joint not in results.torque_steps:
                worst = max(worst, (joint, error), key=itemgetter(1))
    return worst


def _judge_motion(results: Measurements, uses: _Uses) -> None:
    # a long horizon may blow up where a short one tells something
    finite = [x for x in results.horizons if x.errors[MODEL].mean_relative_rms is not None]
    if results.horizons and not finite:
        uses.bad.append("simulation")
        uses.proofs.append("predicts no finite motion")
    for last in finite[-1:]:
        error = _relative(last.errors[MODEL])
        if error <= TUNING.close_prediction:
            uses.good.append(f"simulation {last.name} ahead")
        elif error <= TUNING.rough_prediction:
            uses.good.append(f"rough simulation {last.name} ahead")
        else:
            uses.bad.append(f"simulation {last.name} ahead")
            if _relative(last.errors.get(observed(MODEL))) <= TUNING.rough_prediction:
                uses.good.append(f"prediction {last.name} ahead with a momentum observer")
        proof = f"is off by {share(error, 'the motion')} after {last.name}"
        tip = last.errors[MODEL].tip_mm
        if tip is not None:
            proof += f", {number(tip)} mm at the tip"
        uses.proofs.append(proof)


def _judge_replays(results: Measurements, uses: _Uses) -> None:
    # whole logs stand first: windows forgive what drifts
    for replay in results.replays[:1]:
        error = replay.errors[MODEL].mean
        if error == min(errors.mean for errors in replay.errors.values()):
            uses.good.append("simulation from commands")
        else:
            uses.bad.append("simulation from commands")
        distance = f"{1000 * error:.3g} {thousandths(results.joint_types)}"
        uses.proofs.append(f"misses {distance} of the positions that follow commands, {replay.name}")


def _relative(errors: StateErrors | None) -> float:
    """Return the mean error relative to the motion; infinite where it is not known."""
    if errors is None or errors.mean_relative_rms is None:
        return math.inf
    return errors.mean_relative_rms


def _better_baselines(results: Measurements) -> list[str]:
    """Say at which times ahead a constant velocity is better than the model, and which other baseline is, at what."""
    times: list[str] = []
    better: dict[str, list[str]] = {}
    for horizon in results.horizons:
        errors = {name: _relative(of_predictor) for name, of_predictor in horizon.errors.items()}
        constant_velocity = errors.pop(CONSTANT_VELOCITY, math.inf)
        model_error = min(errors[MODEL], errors.get(observed(MODEL), math.inf))
        best = min(errors, key=errors.__getitem__)
        if constant_velocity < model_error:
            times.append(horizon.name)
        if errors[best] < model_error:
            better.setdefault(best, []).append(f"after {horizon.name}")
    torque = {name: x.mean_nmse for name, x in results.torque.items() if x.mean_nmse is not None}
    best = min(torque, key=torque.__getitem__, default=MODEL)
    if MODEL in torque and best != MODEL:
        better.setdefault(best, []).append("in torque")
    statements = []
    if times:
        ahead = f"A constant velocity predicts better {listed(times)} ahead"
        statements.append(f"{ahead}: there, use the model for torques only.")
    if better:
        reasons = [f"{name} is better {listed(occasions)}" for name, occasions in better.items()]
        statements.append(f"But {listed(reasons)}.")
    return statements


def _worst_joint(results: Measurements) -> tuple[str, str, str]:
    """Return the joint whose torque is explained least, or whose motion is where that alone fails; when; and a sentence
    about it.
    """
    joint, error = _worst_torque(results)
    moved, motion_error = _worst_motion(results)
    motion_alone = error <= 1 - TUNING.explained_for_contacts and motion_error > TUNING.close_prediction
    if moved and (motion_alone or not joint):
        amount = share(motion_error, "the motion")
        return moved, "", f"At {moved} the error after {results.horizons[-1].name} is {amount}."
    if not joint:
        return "", "", ""
    speed = _slow_or_fast(results, results.joints.index(joint))
    amount = share(math.sqrt(error), "the torque's standard deviation")
    return joint, speed, f"At {joint} the torque residual is {amount}."


def _worst_motion(results: Measurements) -> tuple[str, float]:
    """Return the joint that the longest rollouts miss by most of its motion, and by how much of it."""
    for last in results.horizons[-1:]:
        errors = np.array(last.errors[MODEL].q_relative_rms, dtype=float)  # NaN of None
        if np.isfinite(errors).all():
            return results.joints[errors.argmax()], errors.max()
    return "", math.inf


def _slow_or_fast(results: Measurements, k: int) -> str:
    """Return at which speed of joint k the residuals of its torque are larger, where they differ."""
    if not results.traces.torques:
        return ""
    residuals, speeds = [], []
    for trace in results.traces.torques:
        residuals.append(trace.measured[:, k] - trace.predicted[MODEL][:, k])
        speeds.append(np.abs(trace.qd[:, k]))
    squares, speed = np.square(np.concatenate(residuals)), np.concatenate(speeds)
    slow = speed < TUNING.slow * np.nanmax(speed)
    # a handful of samples tells no root mean square
    if not 5 < slow.sum() < len(slow) - 5:
        return ""
    ratio = np.sqrt(np.nanmean(squares[slow]) / np.nanmean(squares[~slow]))
    if ratio > TUNING.uneven:
        return STANDSTILL
    return " at speed" if ratio < 1 / TUNING.uneven else ""


def _recommendations(
    results: Measurements, identified: Mapping[str, Any], limits: Limits, worst: str, speed: str
) -> dict[str, str]:
    """Return which motions to record, the most useful first, and why. worst: a joint, which fails at this speed."""
    recommendations = {}
    trained = identified.get("coverage") or {}
    unseen = identified.get("unseen_directions")
    if unseen:
        reason = f"The training logs do not excite {unseen} directions of the base parameters."
        recommendations["a richer motion (as spelgen excite proposes)"] = reason
    outside = _outside(trained, results.traces.coverage, results.joints)
    if outside:
        reason = f"The test logs exceed the range of the training logs: {shortened(outside, 3)}."
        recommendations[f"motion with the {outside[0]} that the test logs have"] = reason
    if speed == STANDSTILL:
        recommendations[f"slow reversals of {worst}"] = "Dry friction is learned from slow reversals."
    fractions = {}
    for joint, covered, bound in zip(results.joints, trained.get("q", ()), limits, strict=False):
        if bound is not None and bound[1] > bound[0]:
            # a turn shows all of a joint that can go on turning
            fractions[joint] = (covered["high"] - covered["low"]) / min(bound[1] - bound[0], 2 * math.pi)
    if fractions:
        joint = min(fractions, key=fractions.__getitem__)
        if fractions[joint] < TUNING.narrow_range:
            reason = f"{joint} has moved over {share(fractions[joint], 'its range')}."
            recommendations[f"wider motion of {joint}"] = reason
    return recommendations


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
