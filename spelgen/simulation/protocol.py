"""What all protocols of a simulation have in common: friction, where motions start, and the logs that they give."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from spelgen.arm.arm import Arm
from spelgen.dynamics.joint_friction import DriveFriction, joint_friction
from spelgen.errors import SettingsError, collect
from spelgen.logs.trajectory import Trajectory, trajectory_listing
from spelgen.settings.settings import Settings


class SimulatedLogs(list[Trajectory]):
    """Hold simulated trajectories, those for training (`train`) first, then those for testing (`test`)."""

    def __init__(self, train: Sequence[Trajectory], test: Sequence[Trajectory]) -> None:
        super().__init__([*train, *test])
        self.train, self.test = tuple(train), tuple(test)

    def __repr__(self) -> str:
        return f"<SimulatedLogs: {len(self.train)} to train, {len(self.test)} to test>"

    def _repr_html_(self) -> str:
        return trajectory_listing(self).html()


def make_friction(arm: Arm, settings: Settings, speeds: np.ndarray | None = None) -> DriveFriction:
    """Return the friction of the arm: a joint's settings where it has some, else its URDF's <dynamics>.

    speeds: C (n, n) of the drives. Where they move several joints, a joint's friction is that of its drive, as in the
    models.
    """
    width = settings.simulation.coulomb_smoothing_velocity
    return joint_friction(arm.coordinates, settings.joints, width, speeds)


def initial_range(arm: Arm, settings: Settings) -> tuple[np.ndarray, np.ndarray]:
    """Return the lowest and highest positions (n,) [rad; m] to start from; SettingsError where a joint has none."""
    positions = settings.simulation.positions or {}
    ranges, errors = [], []
    for joint in arm.coordinates:
        if joint.name in positions:
            ranges.append(positions[joint.name])
        elif joint.continuous:
            ranges.append((-np.pi, np.pi))
        elif joint.lower is not None and joint.upper is not None and joint.lower < joint.upper:
            ranges.append((joint.lower, joint.upper))
        else:
            # 0 to 0 is what exporters write where nobody said a range
            message = "the joint has no range: give its lowest and highest initial position"
            errors.append(SettingsError(message, element=f"simulation.positions.{joint.name}"))
    collect(errors)
    lowest, highest = np.array(ranges, dtype=float).T
    return lowest, highest
