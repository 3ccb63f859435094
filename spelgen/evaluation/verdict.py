"""The assessment of an evaluation in words: suitable uses, failures, and the motions to record next."""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from spelgen.baselines.registry import FittedBaselines
from spelgen.errors import shortened
from spelgen.evaluation.horizons import StateErrors
from spelgen.evaluation.results import Results, Verdict
from spelgen.evaluation.tuning import TUNING
from spelgen.labels import CONSTANT_VELOCITY, MODEL, listed, observed, share, thousandths
from spelgen.listing import number
from spelgen.logs.checks import ELASTIC

SEEN = "tested-on-training-data"
TORQUE_USES: tuple[tuple[float, Sequence[str], Sequence[str]], ...] = (
    (TUNING.explained_for_contacts, ["feed-forward control", "contact detection"], []),
    (TUNING.explained_for_feed_forward, ["feed-forward control"], ["contact detection"]),
    (TUNING.explained_for_gravity, ["gravity compensation"], ["feed-forward control"]),
    (-math.inf, [], ["control"]),
)
"""Minimum explained fraction of the torque variance, uses for which the model is sufficient, uses for which not."""
Limits = Sequence[tuple[float, float] | None]
"""Lower and upper position limit of each joint [rad, m]; None for a joint without limits."""


@dataclass
class _Uses:
    """Uses of a model, which the assessment functions fill in.

    good: uses for which the model is sufficient. bad: uses for which the model is not sufficient. proofs: texts with
    the errors from which this was decided.
    """

    good: list[str] = field(default_factory=list)
    bad: list[str] = field(default_factory=list)
    proofs: list[str] = field(default_factory=list)


def verdict(
    results: Results,
    identified: FittedBaselines | None = None,
    limits: Limits = (),
    independent: Collection[str] = (),
) -> Verdict:
    """Return the assessment of an evaluation.

    identified: content of least_squares.json, with the range of motion of the training logs, from which recommendations
    of further recordings are computed. limits: position limits of the joints. independent: names of joints on whose
    position the dynamics do not depend, such as a vertical first axis.
    """
    # Each assessment function adds the uses for which the model is or is not sufficient, and texts with the errors that
    # decide this.
    uses = _Uses()
    _assess_torques(results, uses)
    good_torques = bool(uses.good)
    _assess_motion(results, uses)
    _assess_replays(results, uses)
    # If neither torques nor motion were evaluated, there is nothing to assess. This happens with --quick on logs
    # without accelerations.
    if not uses.proofs:
        return Verdict("No verdict: no horizon and no torque was evaluated.", "")
    sentence = f"Good enough for {listed(uses.good)}" if uses.good else "Not accurate enough yet"
    elastic = next((x for x in results.diagnostics if x.code == ELASTIC), None)
    if elastic is not None:
        # A rigid model is wrong near the resonance of an elastic joint, even if its errors on these logs are small.
        # Therefore the verdict begins with this limitation, and not with "Good enough".
        band = f"; below it, usable for {listed(uses.good)}" if uses.good else ""
        sentence = f"Not valid near the resonance of an elastic joint{band}"
    if any(diagnostic.code == SEEN for diagnostic in results.diagnostics):
        sentence = f"Evaluated on training logs: {sentence[0].lower()}{sentence[1:]}"
    if uses.good and uses.bad:
        sentence += f", not for {listed(uses.bad)}"
    joint, proof = _worst_joint(results)
    recommendations = _recommendations(results, identified or {}, limits, independent)
    details = [f"worst at {joint}"] if joint else []
    details += [f"next, record {motion}" for motion in list(recommendations)[:1]]
    because = [] if elastic is None else [f"{elastic.where}: {elastic.message}."]
    for detail in details:
        # A detail that would make the first sentence too long becomes a sentence of its own.
        if len(f"{sentence}; {detail}".split()) <= TUNING.headline:
            sentence += f"; {detail}"
        else:
            because.append(f"{detail[0].upper()}{detail[1:]}.")
    because += [f"The model {listed(uses.proofs)}.", proof, *_better_baselines(results, good_torques)]
    because += recommendations.values()
    return Verdict(f"{sentence}.", " ".join(filter(None, because)))


def _assess_torques(results: Results, uses: _Uses) -> None:
    """Assess the uses of the model by its torque error: add the sufficient and the insufficient uses to `uses`.

    The text with the error is added to `uses.proofs`. The joint with the largest error decides, since a mean over
    joints would hide this joint.
    """
    torque = results.torque.get(MODEL)
    if torque is None or torque.mean_nmse is None:
        return
    joint, unexplained = _worst_torque(results)
    if not joint:
        unexplained = torque.mean_nmse
    # 1 - nMSE is the coefficient of determination, the explained fraction of the torque variance.
    _, good, bad = next(row for row in TORQUE_USES if 1 - unexplained >= row[0])
    uses.good += good
    uses.bad += bad
    mean, worst = (share(max(0.0, 1 - nmse)) for nmse in (torque.mean_nmse, unexplained))
    proof = f"explains {mean} of the variance of the torques"
    if worst != mean:
        proof += f" ({worst} at {joint})"
    uses.proofs.append(proof)


def _worst_torque(results: Results) -> tuple[str, float]:
    """Return the joint with the largest nMSE of the model, and the nMSE; coarsely quantised torques are omitted."""
    torque = results.torque.get(MODEL)
    errors = {} if torque is None else dict(zip(results.joints, torque.joint_nmse, strict=False))
    nmse = {x: error for x, error in errors.items() if error is not None and x not in results.torque_steps}
    joint = max(nmse, key=nmse.__getitem__, default="")
    return joint, nmse.get(joint, -math.inf)


def _assess_motion(results: Results, uses: _Uses) -> None:
    # The longest horizon with a finite error is assessed, because predictions may diverge over longer horizons.
    finite = [x for x in results.horizons if x.errors[MODEL].mean_relative_rms is not None]
    if results.horizons and not finite:
        uses.bad.append("simulation")
        uses.proofs.append("predicts no finite motion")
    for last in finite[-1:]:
        error = _relative(last.errors[MODEL])
        simulation = f"simulation {last.name} ahead"
        if error > TUNING.rough_prediction:
            uses.bad.append(simulation)
            if _relative(last.errors.get(observed(MODEL))) <= TUNING.rough_prediction:
                uses.good.append(f"prediction {last.name} ahead with a momentum observer")
        else:
            uses.good.append(simulation if error <= TUNING.close_prediction else f"rough {simulation}")
        proof = f"is off by {share(error, 'the motion')} after {last.name}"
        tip = last.errors[MODEL].tip_mm
        if tip is not None:
            proof += f", {number(tip)} mm at the tip"
        if last is not results.horizons[-1]:
            proof += f" (diverged after {results.horizons[-1].name})"
        uses.proofs.append(proof)


def _assess_replays(results: Results, uses: _Uses) -> None:
    # `replays[0]` is the replay of whole logs. Only this replay is assessed: the later ones are replays of windows of
    # one second, which do not show drift.
    for replay in results.replays[:1]:
        error = replay.errors[MODEL].mean
        if error == min(errors.mean for errors in replay.errors.values()):
            uses.good.append("simulation from commands")
        else:
            uses.bad.append("simulation from commands")
        distance = f"{1000 * error:.3g} {thousandths(results.joint_types)}"
        uses.proofs.append(f"misses {distance} of the positions that follow commands, {replay.name}")


def _relative(errors: StateErrors | None) -> float:
    """Return the relative error, averaged over q and qd of all joints; infinity if unknown.

    A relative error is the RMS error divided by the RMS change of q or qd over the prediction horizon.
    """
    if errors is None or errors.mean_relative_rms is None:
        return math.inf
    return errors.mean_relative_rms


def _better_baselines(results: Results, good_torques: bool) -> list[str]:
    """Return sentences that name the baselines with a smaller error than the model: at which horizons, or in torque.

    1. A sentence lists the horizons at which the baseline of constant velocity predicts better than the model. If
       ``good_torques`` is True (torque errors small enough for a use), it adds that at these horizons the model should
       be used only for torques, not for predictions.
    2. For each horizon, and for torque, the best of all other baselines is listed if it is better than the model. The
       error of the model is the smaller error of its predictions with and without observer.
    """
    times = []
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
    # Torques are compared without the observer, which only corrects predictions of motion.
    best = min(torque, key=torque.__getitem__, default=MODEL)
    if MODEL in torque and best != MODEL:
        better.setdefault(best, []).append("in torque")
    statements = []
    if times:
        ahead = f"A constant velocity predicts better {listed(times)} ahead"
        statements.append(f"{ahead}: there, use the model for torques only." if good_torques else f"{ahead}.")
    reasons = [f"{name} is better than the model {listed(occasions)}" for name, occasions in better.items()]
    return [*statements, f"But {listed(reasons)}."] if reasons else statements


def _worst_joint(results: Results) -> tuple[str, str]:
    """Return the name of the worst joint, "" if no error is known, and a sentence about its motion error.

    The worst joint is the joint with the largest torque error. If all torque errors are small and the motion error is
    not, it is the joint with the largest motion error.
    """
    joint, error = _worst_torque(results)
    moving, motion_error = _worst_motion(results)
    only_motion = error <= 1 - TUNING.explained_for_contacts and motion_error > TUNING.close_prediction
    if moving and (only_motion or not joint):
        amount = share(motion_error, "the motion")
        return moving, f"At {moving} the error after {results.horizons[-1].name} is {amount}."
    return joint, ""


def _worst_motion(results: Results) -> tuple[str, float]:
    """Return the joint with the largest motion error at the longest horizon, and this error.

    The error is relative: RMS error divided by RMS change over the horizon, averaged over q and qd.
    """
    for last in results.horizons[-1:]:
        # The error of a joint is the mean of its errors of q and qd. `mean_relative_rms`, which the assessment compares
        # with thresholds, is the mean of these errors over the joints: the error of the worst joint is not smaller. An
        # unknown error (None) becomes NaN.
        of_model = last.errors[MODEL]
        errors = np.mean(np.array([of_model.q_relative_rms, of_model.qd_relative_rms], dtype=float), axis=0)
        if np.isfinite(errors).all():
            return results.joints[errors.argmax()], errors.max()
    return "", math.inf


def _recommendations(
    results: Results, identified: FittedBaselines, limits: Limits, independent: Collection[str]
) -> dict[str, str]:
    """Return {motion to record: reason}, the most useful motion first.

    Args:
        results: the evaluation.
        identified: content of least_squares.json, with the range of motion of the training logs.
        limits: position limits of the joints.
        independent: names of joints on whose position the dynamics do not depend.
    """
    recommendations = {}
    trained = identified.get("coverage") or {}
    unseen = identified.get("unseen_directions")
    # Undetermined parameters come first: no further fit to these logs can improve them.
    if unseen:
        reason = f"The training logs do not excite {unseen} directions of the base parameters."
        recommendations["a richer motion (as spelgen excite proposes)"] = reason
    outside = _outside(trained, results.traces.coverage, results.joints, independent)
    if outside:
        reason = f"The test logs exceed the range of the training logs: {shortened(outside, 3)}."
        recommendations[f"motion with the {outside[0]} that the test logs have"] = reason
    fractions = {}
    for joint, covered, bound in zip(results.joints, trained.get("q", ()), limits, strict=False):
        if bound is not None and bound[1] > bound[0] and joint not in independent:
            # A motion of one revolution covers all positions of a revolute joint, so a wider range counts as one
            # revolution.
            fractions[joint] = (covered["high"] - covered["low"]) / min(bound[1] - bound[0], 2 * math.pi)
    # Only the joint that has moved over the smallest fraction of its range is named: users follow one recommendation
    # rather than a list.
    joint = min(fractions, key=fractions.__getitem__, default="")
    if joint and fractions[joint] < TUNING.narrow_range:
        reason = f"{joint} has moved over {share(fractions[joint], 'its range')}."
        recommendations[f"wider motion of {joint}"] = reason
    return recommendations


def _outside(
    trained: Mapping[str, Any], tested: Mapping[str, Any], joints: Sequence[str], independent: Collection[str]
) -> list[str]:
    """Return the positions and velocities, such as "positions of elbow", that exceed the range of the training logs.

    A quantity is returned if the test logs exceed either end of the range by more than 10 % of the range. trained,
    tested: `coverage` of the training logs and of the test logs. independent: names of joints on whose position the
    dynamics do not depend; their positions are omitted.
    """
    exceeded = []
    for quantity, word in (("q", "positions"), ("qd", "velocities")):
        ranges = zip(joints, trained.get(quantity, ()), tested.get(quantity, ()), strict=False)
        for name, inner, outer in ranges:
            if quantity == "q" and name in independent:
                continue
            # An excess of 10 % of the range is tolerated, because models extrapolate over small distances.
            room = 0.1 * (inner["high"] - inner["low"])
            if outer["low"] < inner["low"] - room or outer["high"] > inner["high"] + room:
                exceeded.append(f"{word} of {name}")
    return exceeded
