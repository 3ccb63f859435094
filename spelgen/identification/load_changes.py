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

    The torques of all recordings are fitted by one set of parameters, and in addition by one mass and first moment of
    the last body per recording. Changes are returned if these lower the negative log likelihood significantly, and by
    more than torque offsets, and more than viscous and Coulomb friction, of each recording do. They are returned for
    recordings whose load differs significantly from the load of the reference, and in which it at least halves the
    squared residual of a joint.

    problem: least-squares problem of the samples of all recordings.
    """
    changes = list[LoadChange]()
    numbers, counts = np.unique(problem.samples.recording, return_counts=True)
    known = numbers[counts >= FEWEST].tolist()
    for first in range(1, len(known), TOGETHER):
        changes += _changes(problem, [known[0], *known[first : first + TOGETHER]])
    return changes


def _changes(problem: GeometryProblem, recordings: Sequence[int]) -> list[LoadChange]:
    """Return the changes of the load in some recordings (see `load_changes`)."""
    part = problem.part(np.isin(problem.samples.recording, recordings)).thinned(SAMPLES)
    fit = part.fit(part.unchanged)
    rows, _ = part.equations(part.unchanged)
    last, n = 10 * (len(problem.arm.bodies) - 1), rows.shape[1]
    offsets = np.broadcast_to(np.eye(n), (len(rows), n, n))
    # The first effects of `FRICTION` are the armature, viscous and Coulomb friction.
    friction = rows[..., last + 10 + n : last + 10 + 3 * n]
    common, offset, other_friction, load = (
        _Refit(part, fit, columns, recordings)
        for columns in (rows[..., :0], offsets, friction, rows[..., last : last + 4])
    )
    if load.misfit > min(offset.misfit, other_friction.misfit, common.misfit - GEOMETRY.needed):
        return []
    # The reference is the recording with the median mass, since most recordings usually have the same load.
    order = np.argsort(load.quantities[:, 0], kind="stable")
    reference = order[(len(order) - 1) // 2]
    changes = []
    for k, recording in enumerate(recordings):
        if load.is_needed(k, reference):
            change, covariance = load.difference(k, reference)
            deviation = float(np.sqrt(covariance[0, 0]))
            changes.append(LoadChange(recording, recordings[reference], float(change[0]), deviation))
    return changes


class _Refit:
    """Fit of torques with additional quantities of each recording: D quantities of each of R recordings.

    Attributes:
        quantities: (R, D) quantities of the recordings minus those of the first one.
        misfit: negative log likelihood.
    """

    def __init__(
        self, problem: GeometryProblem, fit: HypothesisFit, columns: np.ndarray, recordings: Sequence[int]
    ) -> None:
        """Fit the torques of `problem`, starting from its fit without additional quantities.

        columns: (S, n, D) derivative of the torques with respect to the quantities of the sample's recording.
        recordings: indices of the R recordings.
        """
        self._rows = [problem.samples.recording == number for number in recordings]
        self._columns = columns
        others = [columns * rows[:, None, None] for rows in self._rows[1:]]
        joined, size = np.concatenate(others, axis=2), columns.shape[2]
        tau = problem.unchanged.signals(problem.samples).tau
        # The weights of the joints depend on the residual, which the quantities reduce, so the fit is repeated.
        for _ in range(3):
            change, self._covariance = problem.estimate(fit, joined)
            common, added = np.split(change, [len(fit.parameters)])
            residual = problem.residual(problem.unchanged, fit.parameters + common) + joined @ added
            errors = np.square(residual).mean(axis=0) / np.maximum(tau.var(axis=0), 1e-30)
            fit = replace(fit, errors=errors, parameters=fit.parameters + common)
        self._residual, self.misfit = residual, problem.misfit(errors)
        self.quantities = np.append(np.zeros((1, size)), added.reshape(len(others), size), axis=0)

    def is_needed(self, k: int, reference: int) -> bool:
        """Return True if the quantities of recording k differ from those of `reference`, and explain its torques.

        The difference must be significant, and the squared residual of one joint in recording k must at least be
        doubled with the quantities of `reference`.
        """
        change, covariance = self.difference(k, reference)
        rows = self._rows[k]
        other = self._residual[rows] - self._columns[rows] @ change
        ratio = np.square(other).mean(axis=0) / np.maximum(
            np.square(self._residual[rows]).mean(axis=0), 1e-30
        )
        odds = 0.5 * float(change @ np.linalg.pinv(covariance, hermitian=True) @ change)
        return odds > GEOMETRY.needed and bool((ratio > 2).any())

    def difference(self, k: int, reference: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the quantities (D,) of recording k minus those of `reference`, and their covariance (D, D)."""
        size = self.quantities.shape[1]
        start = len(self._covariance) - size * len(self._rows)
        weights = np.zeros((size, len(self._covariance)))
        for number, sign in ((k, 1.0), (reference, -1.0)):
            # The quantities of the first recording are zero, and have no rows in the covariance.
            if number:
                weights[:, start + size * number :][:, :size] = sign * np.eye(size)
        return self.quantities[k] - self.quantities[reference], weights @ self._covariance @ weights.T
