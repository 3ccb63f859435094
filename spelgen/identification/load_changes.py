"""Loads that differ between recordings: the model of one load is wrong for recordings with another one."""

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

    The torques of all recordings are fitted by one set of parameters, plus one load per recording: a mass and a first
    moment that are added to the last body. The loads must lower the negative log likelihood significantly. Two other
    models must lower it less: one torque offset per joint and recording, and own viscous and Coulomb friction of each
    recording. A change is then returned for each recording that meets two conditions: its load differs significantly
    from the load of the reference recording, and its own load at least halves the squared residual of some joint.

    problem: least-squares problem of the samples of all recordings.
    """
    changes = dict[int, LoadChange]()
    numbers, counts = np.unique(problem.samples.recording, return_counts=True)
    known = numbers[counts >= FEWEST].tolist()
    for first in range(1, len(known), TOGETHER):
        for change in _changes(problem, [known[0], *known[first : first + TOGETHER]]):
            # The first recording is part of every group of recordings; of its several changes, the first is returned.
            changes.setdefault(change.recording, change)
    return list(changes.values())


def _changes(problem: GeometryProblem, recordings: Sequence[int]) -> list[LoadChange]:
    """Return the changes of the load between the given recordings (indices), see `load_changes`."""
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
