"""Changes between and within recordings: another load, and torques that have another scale or zero from a time on.

One model of recordings with different loads, or of torques before and after a change, is wrong for all of them.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from spelgen.identification.hypotheses import HypothesisFit
from spelgen.identification.log_geometry import GeometryProblem
from spelgen.identification.tuning import GEOMETRY

TOGETHER = 20
"""Number of recordings that are compared at a time. It bounds the number of columns of the least-squares problem."""
SAMPLES = 1200
"""Largest number of samples of these recordings."""
SLIGHT = 15.0
"""Decrease of the cost by an approximate change of the torques below which the exact decrease is not computed."""
FEWEST = 20
"""Number of samples below which a recording is not compared with others."""


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

    The torques of all recordings are fitted by one set of parameters, and in addition by a mass and first moment of the
    last body for each recording. These loads must lower the negative log likelihood significantly, and by more than
    torque offsets, or viscous and Coulomb friction, of each recording would. A change is then returned for each
    recording whose load differs significantly from the load of the reference, and whose squared residual of some joint
    is at least halved by its own load.

    problem: least-squares problem of the samples of all recordings.
    """
    changes = dict[int, LoadChange]()
    numbers, counts = np.unique(problem.samples.recording, return_counts=True)
    known = numbers[counts >= FEWEST].tolist()
    for first in range(1, len(known), TOGETHER):
        for change in _changes(problem, [known[0], *known[first : first + TOGETHER]]):
            # The first recording is compared with all others, and is returned once.
            changes.setdefault(change.recording, change)
    return list(changes.values())


def _changes(problem: GeometryProblem, recordings: Sequence[int]) -> list[LoadChange]:
    """Return the changes of the load in some recordings (see `load_changes`)."""
    subset = problem.selected(np.isin(problem.samples.recording, recordings)).thinned(SAMPLES)
    fit = subset.fit(subset.unchanged)
    rows, _ = subset.equations(subset.unchanged)
    last, n = 10 * (len(problem.arm.bodies) - 1), rows.shape[1]
    offsets = np.broadcast_to(np.eye(n), (len(rows), n, n))
    # The first effects of `FRICTION` are the armature, viscous and Coulomb friction.
    friction = rows[..., last + 10 + n : last + 10 + 3 * n]
    common, offset, other_friction, load = (
        _refit(subset, fit, columns, recordings)
        for columns in (rows[..., :0], offsets, friction, rows[..., last : last + 4])
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
        unchanged = residual - rows[samples, :, last : last + 4] @ change
        is_needed = np.square(unchanged).sum(axis=0) > 2 * np.square(residual).sum(axis=0)
        if odds > GEOMETRY.needed and is_needed.any():
            deviation = float(np.sqrt(covariance[0, 0]))
            changes.append(LoadChange(recording, recordings[reference], float(change[0]), deviation))
    return changes


class TorqueChange(NamedTuple):
    """Change of the scale or zero of logged torques within a recording.

    Attributes:
        recording: index of the recording.
        time: time of the change since the start of the recording [s].
        joint: index of the joint, or None for a change of the torques of all joints.
        factor: ratio of the torques after the change to the torques before it.
        offset: torque that is added after the change [Nm, N]; 0 if the scale changes.
    """

    recording: int
    time: float
    joint: int | None
    factor: float
    offset: float


def torque_change(problem: GeometryProblem) -> TorqueChange | None:
    """Return the change of the scale or zero of torques that the samples of a log show most clearly, or None.

    The changes are: another factor on the torque of one joint or, in common, of all joints, and another offset of the
    torque of one joint. A change must lower the negative log likelihood by `GEOMETRY.needed` more than another load,
    and more than other friction of the joints together with offsets that drift: a load that the arm picks up, friction
    that falls as the drives warm up, and drifting sensors are no changes of the torques' unit.
    """
    subset = problem.thinned(SAMPLES).with_hysteresis()
    fit = subset.fit(subset.unchanged)
    residual = subset.residual(subset.unchanged, fit.parameters)
    torque = residual + subset.unchanged.signals(subset.samples).tau
    variance = len(residual) * np.maximum(subset.unchanged.signals(subset.samples).tau.var(axis=0), 1e-30)
    found = list[tuple[float, int | None, int, float]]()
    for recording in np.unique(subset.samples.recording).tolist():
        rows = subset.samples.recording == recording
        times = subset.samples.times[rows]
        # A time is tested after each twentieth of the samples.
        splits = len(times) * np.arange(2, 19) // 20
        if len(times) < 4 * FEWEST or not times.any():
            continue
        falls = _falls(torque[rows], residual[rows], splits) / variance
        floor = GEOMETRY.error_floor
        errors = np.maximum(fit.errors - falls, 0.0) + floor
        misfits = subset.count / 2 * np.log(errors / (fit.errors + floor))
        split, joint = np.unravel_index(misfits.argmin(), misfits.shape)
        found.append((float(misfits[split, joint]), int(joint), recording, float(times[splits[split]])))
        split = misfits.sum(axis=1).argmin()
        found.append((float(misfits[split].sum()), None, recording, float(times[splits[split]])))
    best, decrease = None, GEOMETRY.needed
    for is_single in (True, False):
        likely = [x for x in found if (x[1] is not None) == is_single]
        misfit, joint, recording, time = min(likely, default=(0.0, None, 0, 0.0), key=lambda x: x[0])
        # The exact comparison takes time: it is omitted if the residual shows hardly any change.
        if misfit < -SLIGHT:
            change, fall = _change(subset, fit, torque, (recording, time, joint))
            if fall > decrease:
                best, decrease = change, fall
    return best


def _falls(torque: np.ndarray, residual: np.ndarray, splits: np.ndarray) -> np.ndarray:
    """Return decreases (C, n) of squared residuals by separate factors and offsets of torques before and after times.

    torque, residual: torques of the model and their residuals, (S, n) [Nm, N]. splits: (C,) numbers of samples before
    each time.
    """
    ones = np.ones_like(torque)
    products = [torque * torque, torque, ones, torque * residual, residual]
    before = np.cumsum(products, axis=1)[:, splits - 1]
    total = np.sum(products, axis=1)[:, None]

    def explained(sums: np.ndarray) -> np.ndarray:
        """Return the squares that a factor and an offset explain, from sums of products (5, C, n)."""
        squares, sum_, count, product, rest = sums
        slope = product - sum_ * rest / count
        return np.asarray(
            rest**2 / count + slope**2 / np.maximum(squares - sum_**2 / count, 1e-9 * squares + 1e-30)
        )

    return explained(before) + explained(total - before) - explained(total)


def _change(
    problem: GeometryProblem, fit: HypothesisFit, torque: np.ndarray, where: tuple[int, float, int | None]
) -> tuple[TorqueChange, float]:
    """Return the change of the torques at a time, and the fall of the cost compared with a load or other friction.

    where: recording, time [s], and joint with the change, None for all joints.
    """
    recording, time, joint = where
    rows, _ = problem.equations(problem.unchanged)
    last, n = 10 * (len(problem.arm.bodies) - 1), rows.shape[1]
    chosen = np.arange(n) if joint is None else np.array([joint])
    part = (problem.samples.recording == recording)[:, None, None]
    late = part & (problem.samples.times >= time)[:, None, None]
    offsets = np.broadcast_to(np.eye(n)[:, chosen], (len(rows), n, len(chosen)))
    drift = offsets * (problem.samples.times / problem.samples.times.max())[:, None, None] * part
    viscous = last + 10 + n  # the first effects of `FRICTION` are the armature, viscous and Coulomb friction
    friction = rows[..., np.concatenate([viscous + chosen, viscous + n + chosen])] * late
    factor = torque[..., None] * offsets.any(axis=2)[..., None]
    joined = problem.selected(np.full(len(rows), True))
    joined.samples = joined.samples._replace(recording=np.zeros(len(rows), int))
    alternatives = [
        rows[..., :0],
        rows[..., last : last + 4] * late,
        np.concatenate([friction, drift], axis=2),
    ]
    bound = min(_refit(joined, fit, columns, [0]).misfit for columns in alternatives)
    scaled = _refit(joined, fit, factor * late, [0])
    refit, ratio, offset = scaled, 1 + float(scaled.quantities[0, 0]), 0.0
    if joint is not None:
        shifted = _refit(joined, fit, offsets * late, [0])
        if shifted.misfit < scaled.misfit:
            refit, ratio, offset = shifted, 1.0, float(shifted.quantities[0, 0])
    variance = np.maximum(problem.unchanged.signals(problem.samples).tau.var(axis=0), 1e-30)
    # Other faults of the log leave a large residual.
    is_explained = np.mean(np.square(refit.residual).mean(axis=0) / variance) <= GEOMETRY.explained
    return TorqueChange(recording, time, joint, ratio, offset), (bound - refit.misfit) * bool(is_explained)


class _Refit(NamedTuple):
    """Fit of torques with D additional quantities of each of R recordings.

    Attributes:
        misfit: negative log likelihood.
        residual: torques of the model minus the logged torques, (S, n) [Nm, N].
        quantities: (R, D) quantities of the recordings.
        covariance: (R, D, R, D) covariance of the quantities.
    """

    misfit: float
    residual: np.ndarray
    quantities: np.ndarray
    covariance: np.ndarray


def _refit(
    problem: GeometryProblem, fit: HypothesisFit, columns: np.ndarray, recordings: Sequence[int]
) -> _Refit:
    """Return the fit of the torques with additional quantities of each recording.

    Args:
        problem: problem with the samples of the recordings.
        fit: its fit without additional quantities.
        columns: (S, n, D) derivative of the torques with respect to the quantities of the sample's recording.
        recordings: indices of the R recordings.
    """
    count, size = len(fit.parameters), columns.shape[2]
    number = problem.samples.recording[:, None, None]
    joined = np.concatenate([columns * (number == recording) for recording in recordings], axis=2)
    variance = np.maximum(problem.unchanged.signals(problem.samples).tau.var(axis=0), 1e-30)
    # The weights of the joints depend on the residual, which the quantities reduce, so the fit is repeated.
    for _ in range(3):
        change, covariance = problem.estimate(fit, joined)
        parameters = fit.parameters + change[:count]
        residual = problem.residual(problem.unchanged, parameters) + joined @ change[count:]
        errors = np.square(residual).mean(axis=0) / variance
        fit = replace(fit, errors=errors, parameters=parameters)
    shape = len(recordings), size
    added = covariance[count:, count:].reshape(*shape, *shape)
    return _Refit(problem.misfit(errors), residual, change[count:].reshape(shape), added)
