"""Hold what a simulation gives: its trajectories, which of them are for training, and how exact they are."""

from __future__ import annotations

from collections.abc import Sequence

from spelgen.logs.trajectory import Trajectory, trajectory_listing

EXACT = 1e-8  # [rad, rad/s; m, m/s]


class SimulatedLogs(list[Trajectory]):
    """Simulated trajectories, those for training first, then those for testing.

    train, test: the two parts. integration_error: largest difference of any logged q or qd [rad, rad/s; m, m/s] to
    the same trajectory integrated with 100 times larger tolerances; the error of what is logged is smaller still.
    allowed: the largest with which these logs are a reference.
    """

    def __init__(
        self,
        train: Sequence[Trajectory],
        test: Sequence[Trajectory],
        integration_error: float,
        allowed: float = EXACT,
    ) -> None:
        super().__init__([*train, *test])
        self.train, self.test = tuple(train), tuple(test)
        self.integration_error, self.allowed = integration_error, allowed

    def __repr__(self) -> str:
        summary = f"{len(self.train)} to train, {len(self.test)} to test"
        return f"<SimulatedLogs: {summary}, integration error {self.integration_error:.1e}>"

    def _repr_html_(self) -> str:
        return trajectory_listing(self).html()
