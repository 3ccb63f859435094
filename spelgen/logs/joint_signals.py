"""Signals of one joint in one trajectory, which checks of logs examine."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from spelgen.logs.trajectory import Trajectory
from spelgen.logs.tuning import SIGNALS


class Advice(NamedTuple):
    """Finding of a check with a remedy that the check has tested."""

    message: str
    do: str


class JointSignals(NamedTuple):
    """Signals of one joint in one trajectory: the subject of the checks without the robot.

    q, qd: (T,). factor: ratio of dq/dt to qd; NaN for a joint at rest. correlations: of qd with dq/dt of each joint;
    NaN for a joint at rest.
    """

    trajectory: Trajectory
    number: int
    kind: str
    joints: Sequence[str]
    q: np.ndarray
    qd: np.ndarray
    factor: float
    correlations: Sequence[float]

    @property
    def turns(self) -> bool:
        """Whether the joint can turn without limit."""
        return self.kind == "continuous" or bool(self.trajectory.mapping.word("period", "q", self.joint))

    @property
    def measured(self) -> tuple[str, ...]:
        """Names of the measured quantities: without commands, and without differentiated velocities."""
        if self.trajectory.u is not None:
            return ("q",)
        return self.trajectory.mapping.quantities if self.trajectory.tau.size else ("q",)

    @property
    def step(self) -> float:
        """Median time between samples [s]; 0 for a single sample."""
        steps = np.diff(self.trajectory.t)
        return float(np.median(steps)) if steps.size else 0.0

    @property
    def joint(self) -> str:
        """Name of the joint."""
        return self.joints[self.number]

    def signal(self, quantity: str) -> np.ndarray:
        """Return "q", "qd", "tau" or "u" of the joint, (T,); (0,) if it was not logged."""
        values: np.ndarray | None = getattr(self.trajectory, quantity)
        return np.zeros(0) if values is None or not values.size else values[:, self.number]

    @property
    def correlation(self) -> float:
        """Correlation of qd and dq/dt."""
        return self.correlations[self.number]

    def changes_by(self, unit: float) -> bool:
        """Return True if dq/dt is this multiple of qd, which indicates a wrong unit."""
        return self.correlation > SIGNALS.agreement and is_factor(self.factor, unit)


def is_factor(value: float, unit: float) -> bool:
    """Return True if a factor equals the factor of a unit within a tolerance."""
    return 1 / SIGNALS.unit_factor < value / unit < SIGNALS.unit_factor
