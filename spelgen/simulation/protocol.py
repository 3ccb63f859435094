"""Parts of all simulation protocols: friction model, sample times, range of positions, desired motions, and results."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from spelgen.arm.arm import Chain
from spelgen.dynamics.friction import DriveFriction, joint_friction
from spelgen.errors import SettingsError, SpelgenError, collect
from spelgen.excitation.bounds import SPEEDS, MotionBounds, range_error
from spelgen.excitation.trajectory import ExcitationTrajectory, Motion
from spelgen.excitation.tuning import TUNING as EXCITATION
from spelgen.logs.trajectory import Trajectory, trajectory_listing
from spelgen.settings.settings import Settings
from spelgen.settings.simulation import SimulationSettings
from spelgen.simulation.tuning import TUNING as SIMULATION

Progress = Callable[[int, int], None]
"""Function that is called after each trajectory with the number of finished trajectories and of all."""


def silent(done: int, total: int) -> None:
    """Do nothing. Default of the argument `progress`."""


class SimulatedLogs(list[Trajectory]):
    """List of simulated trajectories: the training trajectories `train`, then the test trajectories `test`."""

    def __init__(self, train: Sequence[Trajectory], test: Sequence[Trajectory]) -> None:
        super().__init__([*train, *test])
        self.train, self.test = tuple(train), tuple(test)

    @classmethod
    def split(cls, logs: Sequence[Trajectory], test_fraction: float) -> SimulatedLogs:
        """Split logs: the last fraction `test_fraction` are test trajectories; at least one log is for training."""
        trained = len(logs) - min(round(test_fraction * len(logs)), len(logs) - 1)
        return cls(logs[:trained], logs[trained:])

    def __repr__(self) -> str:
        return f"<SimulatedLogs: {len(self.train)} to train, {len(self.test)} to test>"

    def _repr_html_(self) -> str:
        return trajectory_listing(self).html()


def sample_times(simulation: SimulationSettings) -> np.ndarray:
    """Return the times of the samples of one simulated trajectory, (T,) [s], which start at 0.

    simulation: settings with the duration and the sample rate.
    """
    return np.arange(round(simulation.duration * simulation.sample_rate) + 1) / simulation.sample_rate


def make_friction(arm: Chain, settings: Settings, speeds: np.ndarray | None = None) -> DriveFriction:
    """Return the friction model of the drives of a simulated arm.

    The friction of a joint is specified by its settings or, if the settings have none, by <dynamics> in the URDF.

    Args:
        arm: The arm.
        settings: `joints` and the smoothing velocity of `simulation` are used.
        speeds: Matrix C (n, n) of coupled drives, whose speeds are C qd: friction acts on the drives. None: each drive
            moves its own joint.
    """
    width = settings.simulation.coulomb_smoothing_velocity
    return joint_friction(arm.coordinates, settings.joints, width, speeds)


def initial_range(arm: Chain, settings: Settings) -> tuple[np.ndarray, np.ndarray]:
    """Return the lowest and the highest initial position of each joint in simulated trajectories, (n,) each [rad, m].

    Raises ArmError if neither the settings nor the URDF specify a range for a joint.
    """
    positions = settings.simulation.positions or {}
    ranges, errors = [], []
    for joint in arm.coordinates:
        limits = (-np.pi, np.pi) if joint.continuous else joint.limits
        # Limits of 0 and 0 are treated as unknown, because exporters of URDFs write them for an unknown range.
        if joint.name not in positions and (limits is None or limits[0] >= limits[1]):
            errors.append(range_error(joint.name, limits))
        ranges.append(positions.get(joint.name, limits))
    collect(errors)
    lowest, highest = np.array(ranges, dtype=float).T
    return lowest, highest


def paths(arm: Chain, settings: Settings, t: np.ndarray) -> list[Motion]:
    """Return the desired motion of each trajectory, (T, n) each: random motions of the kind in `settings.tracking`.

    The motions are exciting trajectories or sines. The first motions are the same for any number of trajectories.
    Raises SettingsError if sines exceed a joint's range, or if a joint has no range.

    Args:
        arm: The arm.
        settings: `simulation` and `tracking` are used.
        t: Times (T,) [s].
    """
    count = settings.simulation.trajectories
    # Each trajectory has its own random generator, so that the first trajectories are the same for any number of
    # trajectories.
    randoms = np.random.default_rng(settings.simulation.seed).spawn(count)
    low, high = initial_range(arm, settings)
    if settings.tracking.paths == "excitation":
        # The motion uses only the middle part of each range and a moderate speed, as one does with an unknown arm.
        speeds = [
            min(SIMULATION.used_range * (x.velocity or np.inf), SPEEDS[x.joint_type]) for x in arm.coordinates
        ]
        bounds = MotionBounds(low, high, np.array(speeds)).narrowed(SIMULATION.used_range)
        motions = ExcitationTrajectory(float(t[-1]), EXCITATION.min_harmonics, bounds)
        return [motions.motion(random.standard_normal(motions.size), t) for random in randoms]
    middle, amplitude = (low + high) / 2, _amplitude(arm, settings, low, high)
    drawn = [random.uniform(0, 2 * np.pi, len(middle)) for random in randoms]
    if settings.tracking.paths == "same":
        # All joints have the same frequency. A constant that is added to the phases of all joints is therefore a shift
        # in time: all trajectories follow the same path from different starting points.
        drawn = [drawn[0] + 2 * np.pi * number / count for number in range(count)]
    return [sines(middle, amplitude, settings.tracking.frequency, phase, t) for phase in drawn]


def sines(
    middle: np.ndarray, amplitude: np.ndarray | float, frequency: float, phase: np.ndarray, t: np.ndarray
) -> Motion:
    """Return the motion middle + amplitude sin(2 pi frequency t + phase), (T, n).

    Args:
        middle: Mean positions (n,) [rad, m].
        amplitude: Amplitudes (n,) [rad, m].
        frequency: Frequency of all joints [Hz].
        phase: Phases (n,) [rad].
        t: Times (T,) [s].
    """
    omega = 2 * np.pi * frequency
    angle = omega * t[:, None] + phase
    swing = amplitude * np.sin(angle)
    return Motion(t, middle + swing, amplitude * omega * np.cos(angle), -(omega**2) * swing)


def _amplitude(arm: Chain, settings: Settings, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return the amplitudes of the sines along which the joints of a simulated arm move, (n,) [rad, m].

    low, high: ranges of the joints, (n,) each [rad, m]. Raises SettingsError if the amplitude in the settings is larger
    than half the range of a joint.
    """
    amplitude, errors = np.full(len(low), settings.tracking.amplitude), list[SpelgenError]()
    if "amplitude" not in settings.tracking.model_fields_set:
        amplitude = np.minimum(amplitude, SIMULATION.used_range * (high - low) / 2)
    for joint, lowest, highest, swing in zip(arm.coordinates, low, high, amplitude, strict=True):
        if highest - lowest < 2 * swing:
            error = SettingsError(
                f"{swing:g} beside the range {lowest:g} to {highest:g} of {joint.name!r}",
                element="tracking.amplitude", expected="sines within the range",
                do="make it smaller or give the joint wider simulation.positions",
            )  # fmt: skip
            errors.append(error)
    collect(errors)
    return amplitude
