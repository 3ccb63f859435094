"""Hold what a simulation gives: its trajectories, and which of them are for training."""

from __future__ import annotations

from collections.abc import Sequence

from spelgen.logs.trajectory import Trajectory, trajectory_listing


class SimulatedLogs(list[Trajectory]):
    """Hold simulated trajectories, those for training (`train`) first, then those for testing (`test`)."""

    def __init__(self, train: Sequence[Trajectory], test: Sequence[Trajectory]) -> None:
        super().__init__([*train, *test])
        self.train, self.test = tuple(train), tuple(test)

    def __repr__(self) -> str:
        return f"<SimulatedLogs: {len(self.train)} to train, {len(self.test)} to test>"

    def _repr_html_(self) -> str:
        return trajectory_listing(self).html()
