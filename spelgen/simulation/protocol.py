"""Parts that all simulation protocols share: friction, the range of initial positions, and the resulting logs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from spelgen.arm.arm import Arm
from spelgen.dynamics.joint_friction import DriveFriction, joint_friction
from spelgen.errors import SettingsError, collect
from spelgen.logs.trajectory import Trajectory, trajectory_listing
from spelgen.settings.settings import Settings


class SimulatedLogs(list[Trajectory]):
    """Simulated trajectories: those for training (`train`), followed by those for testing (`test`)."""

    def __init__(self, train: Sequence[Trajectory], test: Sequence[Trajectory]) -> None:
        super().__init__([*train, *test])
        self.train, self.test = tuple(train), tuple(test)

    def __repr__(self) -> str:
        return f"<SimulatedLogs: {len(self.train)} to train, {len(self.test)} to test>"

    def _repr_html_(self) -> str:
        return trajectory_listing(self).html()


def make_friction(arm: Arm, settings: Settings, speeds: np.ndarray | None = None) -> DriveFriction:
    """Return the friction of the drives: from a joint's settings if it has any, else from its URDF's <dynamics>.

    Args:
        arm: The arm.
        settings: `joints` and the smoothing velocity of `simulation` are used.
        speeds: C (n, n): the drives' speeds are C qd. None: each drive moves its own joint. Friction belongs to the
            drives, as in the models.
    """
    width = settings.simulation.coulomb_smoothing_velocity
    return joint_friction(arm.coordinates, settings.joints, width, speeds)


def initial_range(arm: Arm, settings: Settings) -> tuple[np.ndarray, np.ndarray]:
    """Return the lowest and the highest initial position, (n,) each [rad; m]; SettingsError if a joint has no range."""
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
            # exporters write 0 to 0 for an unknown range
            message = "the joint has no range: give its lowest and highest initial position"
            errors.append(SettingsError(message, element=f"simulation.positions.{joint.name}"))
    collect(errors)
    lowest, highest = np.array(ranges, dtype=float).T
    return lowest, highest
