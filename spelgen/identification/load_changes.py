"""Changes between and within recordings: another load, and torques that have another scale or zero from a time on.

A single model that is fitted to recordings with different loads, or to torques before and after a change, is wrong for
all of them.
"""

from collections.abc import Sequence
from dataclasses import replace
from operator import itemgetter
from typing import NamedTuple

import numpy as np

from spelgen.identification.hypotheses import HypothesisFit
from spelgen.identification.log_geometry import GeometryProblem
from spelgen.identification.tuning import GEOMETRY
from spelgen.logs.tuning import SAMPLES as MOTION

TOGETHER = 20
"""Number of recordings that are compared at a time. It bounds the number of columns of the least-squares problem."""
SAMPLES = 1200
"""Largest number of samples of the recordings that are compared at a time."""
FEWEST = 20
"""Number of samples below which recordings, or parts of one, are not compared."""
Candidate = tuple[float, int, float, int]
"""Change of the cost, recording, time [s] and joint (n: all n joints) of a possible change of the torques."""


class LoadChange(NamedTuple):
    """Load at the last link in a recording, minus the load in the recording that it is compared with.

    Attributes:
        recording: index of the recording.
        reference: index of the recording that it is compared with.
        mass: difference of the masses [kg].
        deviation: standard deviation of the difference [kg].
    """

    recording: int
    reference: int
    mass: float
    deviation: float


def load_changes(problem: GeometryProblem) -> list[LoadChange]:
    """Return the changes of the load between recordings that the torques show; [] if there are none.

    The torques of all recordings are fitted by one set of parameters, plus one load per recording: a mass and a first
    moment that are added to the body of the last joint. The loads must lower the negative log likelihood significantly.
    Two other models must lower it less: one torque offset per joint and recording, and own viscous and Coulomb friction
    of each recording. A change is then returned for each recording that meets two conditions: its load differs
    significantly from the load of the reference recording, and its own load at least halves the squared residual of
    some joint.

    problem: least-squares problem of the samples of all recordings.
    """
    changes = dict[int, LoadChange]()
    numbers, counts = np.unique(problem.samples.recording, return_counts=True)
    known = numbers[counts >= FEWEST].tolist()
    for first in range(1, len(known), TOGETHER):
        for change in _changes(problem, [known[0], *known[first : first + TOGETHER]]):
            # known[0], the first recording, is compared with every group of at most `TOGETHER` other recordings. A
            # change of its own load may therefore be found in several groups; only the change of the first group is
            # kept.
            changes.setdefault(change.recording, change)
    return list(changes.values())


def _changes(problem: GeometryProblem, recordings: Sequence[int]) -> list[LoadChange]:
    """Return the changes of the load between the given recordings (indices), see `load_changes`."""
    subset = problem.selected(np.isin(problem.samples.recording, recordings)).thinned(SAMPLES)
    fit = subset.fit(subset.unchanged)
    rows, _ = subset.equations(subset.unchanged)
    of_load, inertials, n = _load_columns(problem), 10 * len(problem.arm.bodies), rows.shape[1]
    offsets = np.broadcast_to(np.eye(n), (len(rows), n, n))
    # The first effects of `FRICTION` are the armature, viscous and Coulomb friction.
    friction = rows[..., inertials + n : inertials + 3 * n]
    common, offset, other_friction, load = (
        _refit(subset, fit, columns, [subset.samples.recording == x for x in recordings])
        for columns in (rows[..., :0], offsets, friction, rows[..., of_load])
    )
    if load.misfit > min(offset.misfit, other_friction.misfit, common.misfit - GEOMETRY.needed):
        return []
    # The reference is the recording with the median mass, since most recordings usually have the same load.
    order = np.argsort(load.quantities[:, 0], kind="stable")
    reference = order[(len(order) - 1) // 2]
    changes = []
    for k, recording in enumerate(recordings):
        change = load.quantities[k] - load.quantities[reference]
        blocks = load.covariance[[k, reference]][:, :, [k, reference]]
        covariance = np.einsum("a,aibj,b->ij", [1, -1], blocks, [1, -1])
        odds = 0.5 * change @ np.linalg.pinv(covariance, hermitian=True) @ change
        samples = subset.samples.recording == recording
        residual = load.residual[samples]
        unchanged = residual - rows[samples, :, of_load] @ change
        is_needed = np.square(unchanged).sum(axis=0) > 2 * np.square(residual).sum(axis=0)
        if odds > GEOMETRY.needed and is_needed.any():
            deviation = float(np.sqrt(covariance[0, 0]))
            changes.append(LoadChange(recording, recordings[reference], float(change[0]), deviation))
    return changes


def _load_columns(problem: GeometryProblem) -> slice:
    """Return the columns of the regressor that belong to the mass and the first moment of a load."""
    first = 10 * problem.arm.load_body
    return slice(first, first + 4)


class TorqueChange(NamedTuple):
    """Change of the scale or zero of logged torques within a recording, or of the scale between recordings.

    Attributes:
        recording: index of the recording.
        time: time of the change since the start of the recording [s]; 0 if the whole recording differs from the others.
        joint: index of the joint, or None for a change of the torques of all joints.
        factor: ratio of the torques after the change to the other torques; 1 if the zero changes.
        offset: torque that is added after the change [Nm, N]; 0 if the scale changes.
    """

    recording: int
    time: float
    joint: int | None
    factor: float
    offset: float


def torque_change(problem: GeometryProblem) -> TorqueChange | None:
    """Return the change of the scale or zero of torques that the samples of a log show most clearly, or None.

    A change is another factor on the torque of one joint, a common factor on the torques of all joints, or another
    offset of the torque of one joint, from a time on; or another factor in a whole recording. The samples in motion
    must show the change of a single joint: dry friction or a brake may carry any part of the load of a joint at rest.

    Two other hypotheses are fitted: another load from this time on (the arm picks it up), and other friction from this
    time on together with offsets that drift (warm drives, drifting sensors). A change is returned only if its negative
    log likelihood is lower by `GEOMETRY.needed` than without a change and than under both other hypotheses.
    """
    subset = problem.thinned(GEOMETRY.confirming_samples).with_hysteresis()
    fit = subset.fit(subset.unchanged)
    rows, tau = subset.equations(subset.unchanged)[0], subset.unchanged.signals(subset.samples).tau
    torque = rows @ fit.parameters
    # The fit cannot predict a torque whose sign changes: both parts cancel each other. A torque with a large residual
    # is therefore predicted from the torques of the other joints.
    for k in np.flatnonzero(fit.errors > GEOMETRY.unexplained):
        counted = np.broadcast_to(np.arange(tau.shape[1]) != k, tau.shape)
        torque[:, k] = rows[:, k] @ subset.on_torques(counted).fit(subset.unchanged).parameters
    residual = torque - tau
    number, velocities = subset.samples.recording, subset.samples.motion[1]
    candidates = list[Candidate]()
    for recording in np.unique(number).tolist():
        # Possible times of the change: after 10 %, 15 %, ..., 90 % of the samples of the recording, so that there are
        # enough samples before and after each time; and the start of the recording, for a change between recordings.
        within, outside = np.flatnonzero(number == recording), np.flatnonzero(number != recording)
        times = subset.samples.times[within]
        splits = len(times) * np.arange(2, 19) // 20
        cases = [(within, splits, times[splits])] if len(times) >= 4 * FEWEST and times.any() else []
        if min(len(within), len(outside)) >= FEWEST:
            cases.append((np.append(outside, within), np.array([len(outside)]), np.zeros(1)))
        for chosen, counts, starts in cases:
            is_moving = _moves_on_both_sides(velocities[chosen], counts)
            falls = _falls(torque[chosen], residual[chosen], counts)
            falls = falls / np.maximum(tau.var(axis=0), 1e-30) / len(tau)
            errors = np.maximum(fit.errors - falls, 0.0) + GEOMETRY.error_floor
            misfits = subset.count / 2 * np.log(errors / (fit.errors + GEOMETRY.error_floor))
            misfits = np.column_stack([np.where(is_moving, misfits, 0.0), misfits.sum(axis=1)])
            for joint, split in enumerate(misfits.argmin(axis=0).tolist()):
                candidates.append((float(misfits[split, joint]), recording, float(starts[split]), joint))
    # The exact comparison takes time: it is made for six changes, and omitted if the residual shows hardly any change.
    likely = [x[1:] for x in sorted(candidates)[:6] if x[0] < -GEOMETRY.needed]
    changes = []
    for recording, time, joint in likely:
        fall, change = _change(subset, fit, recording, time, joint)
        if fall > GEOMETRY.needed and change.joint is not None:
            moving = subset.selected(np.abs(velocities[:, joint]) > MOTION.moving)
            fall = min(fall, _change(moving, moving.fit(moving.unchanged), recording, time, joint)[0])
        changes.append((fall, change))
    fall, best = max(changes, key=itemgetter(0), default=(0.0, None))
    return best if fall > GEOMETRY.needed else None


def _moves_on_both_sides(velocities: np.ndarray, splits: np.ndarray) -> np.ndarray:
    """Return the mask (C, n) of the joints with `FEWEST` samples in motion both before and after each of C times.

    velocities: (S, n) [rad/s, m/s]. splits: (C,) numbers of samples before each time.
    """
    moved = np.cumsum(np.abs(velocities) > MOTION.moving, axis=0)
    earlier = moved[splits - 1]
    return np.asarray(np.minimum(earlier, moved[-1] - earlier) >= FEWEST)


def _falls(torque: np.ndarray, residual: np.ndarray, splits: np.ndarray) -> np.ndarray:
    """Return the decrease of the squared residual if torques may change their factor and offset at a time, (C, n).

    Each joint's residual is regressed on the model's torque and on 1 (factor and offset), once on all samples, and once
    separately on the samples before and after each of C times. The result is the difference of both squared residuals
    [Nm^2, N^2]. torque, residual: torques of the model and their residuals, (S, n) [Nm, N]. splits: (C,) numbers of
    samples before each time.
    """
    ones = np.ones_like(torque)
    products = [torque * torque, torque, ones, torque * residual, residual]
    earlier = np.cumsum(products, axis=1)[:, splits - 1]
    total = np.sum(products, axis=1)[:, None]

    def explained(sums: np.ndarray) -> np.ndarray:
        """Return the decrease of the sum of squared residuals by a regression on the torque and on 1, (C, n).

        sums: (5, C, n), sums over the samples before or after each of C times. The five summands are torque^2, torque,
        1, torque * residual and residual.
        """
        squares, torques, count, products, residuals = sums
        slope = products - torques * residuals / count
        return np.asarray(
            residuals**2 / count + slope**2 / np.maximum(squares - torques**2 / count, 1e-9 * squares + 1e-30)
        )

    return np.asarray(explained(earlier) + explained(total - earlier) - explained(total))


def _change(
    problem: GeometryProblem, fit: HypothesisFit, recording: int, time: float, joint: int
) -> tuple[float, TorqueChange]:
    """Return the evidence for a change of the logged torques at `time`, and the change: a new factor or a new offset.

    The evidence is the difference of two negative log likelihoods: the value of the best alternative minus the value of
    the change. The alternatives are another load from `time` on, and other friction from `time` on with drifting
    offsets. The evidence is 0 if the change does not explain the torques. fit: fit of `problem` without a change.
    recording, time, joint: see `Candidate`.
    """
    rows, _ = problem.equations(problem.unchanged)
    inertials, n = 10 * len(problem.arm.bodies), rows.shape[1]
    chosen = np.arange(n) if joint == n else np.array([joint])
    in_recording = (problem.samples.recording == recording)[:, None, None]
    late = in_recording * (problem.samples.times[:, None, None] >= time)
    # `torque` was fitted to the samples before and after the change together; the torques before it are more exact.
    counted = ~(late[..., 0] & np.isin(np.arange(n), chosen))
    torque = rows @ problem.on_torques(counted).fit(problem.unchanged).parameters
    offsets = np.broadcast_to(np.eye(n)[:, chosen], (len(rows), n, len(chosen)))
    columns = [torque[..., None] * np.any(offsets, axis=2, keepdims=True) * late]
    # Sensors of torques are often zeroed before a recording: another zero in a whole recording is no change.
    columns += [offsets * late] if joint < n and time else []
    all_samples = [np.ones(len(rows), bool)]
    refits = [_refit(problem, fit, x, all_samples) for x in columns]
    best = min(refits, key=lambda x: x.misfit)
    quantity = float(best.quantities[0, 0])
    factor, offset = (1 + quantity, 0.0) if best is refits[0] else (1.0, quantity)
    change = TorqueChange(recording, time, joint if joint < n else None, factor, offset)
    # Other faults of the log cause a large residual: of all joints, or twice as large a residual of the changed joint.
    remaining = max(best.errors.mean(), best.errors[chosen].mean() / 2)
    # Between recordings, motor constants may change by a fifth with temperature.
    is_usual = not time and 0.8 < factor < 1.25
    if fit.misfit - best.misfit <= GEOMETRY.needed or remaining > GEOMETRY.explained or is_usual:
        return 0.0, change
    duration = problem.samples.times.max()
    drift = (
        offsets * (problem.samples.times / duration if time else late[:, 0, 0])[:, None, None] * in_recording
    )
    # The columns of friction follow the columns of the armature; viscous and Coulomb friction are first. Bristles are
    # omitted if the zero changes, since they could imitate an offset.
    friction = rows[..., inertials + n : inertials + 3 * n if offset else None]
    friction = friction[..., friction[:, chosen].any(axis=(0, 1))] * late
    alternatives = rows[..., _load_columns(problem)] * late, np.concatenate([friction, drift], axis=2)
    return min(_refit(problem, fit, x, all_samples).misfit for x in alternatives) - best.misfit, change


class _Refit(NamedTuple):
    """Fit of torques with D additional quantities per part of the samples, for example one load per recording.

    There are R parts. Examples of quantities are the mass and the first moment of a load, or a torque offset.

    Attributes:
        misfit: negative log likelihood.
        parameters: (K,) parameters of the arm.
        errors: (n,) mean squared residual of each joint's torque, divided by the variance of the torque.
        residual: torques of the model minus the logged torques, (S, n) [Nm, N].
        quantities: (R, D) quantities of the parts.
        covariance: (R, D, R, D) covariance of the quantities.
    """

    misfit: float
    parameters: np.ndarray
    errors: np.ndarray
    residual: np.ndarray
    quantities: np.ndarray
    covariance: np.ndarray


def _refit(
    problem: GeometryProblem, fit: HypothesisFit, columns: np.ndarray, parts: Sequence[np.ndarray]
) -> _Refit:
    """Return the fit of the torques with D additional quantities per part of the samples (see `_Refit`).

    Args:
        problem: problem with the S samples.
        fit: fit of `problem` without additional quantities.
        columns: (S, n, D) derivatives of the torques with respect to the quantities of the sample's part. Examples:
            regressor columns of the body of the last joint for a load, identity matrices for torque offsets.
        parts: mask (S,) of each part.
    """
    count, size = len(fit.parameters), columns.shape[2]
    joined = np.concatenate([columns * part[:, None, None] for part in parts], axis=2)
    variance = np.maximum(problem.unchanged.signals(problem.samples).tau.var(axis=0), 1e-30)
    # The weight of a joint depends on its torque residual, which is smaller after the fit of the D additional
    # quantities, such as loads or torque offsets. The fit is therefore repeated with the new weights.
    for _ in range(3):
        change, covariance = problem.estimate(fit, joined)
        parameters = fit.parameters + change[:count]
        residual = problem.residual(problem.unchanged, parameters) + joined @ change[count:]
        errors = np.square(residual).mean(axis=0) / variance
        fit = replace(fit, errors=errors, parameters=parameters)
    shape = len(parts), size
    added = covariance[count:, count:].reshape(*shape, *shape)
    return _Refit(problem.misfit(errors), parameters, errors, residual, change[count:].reshape(shape), added)
