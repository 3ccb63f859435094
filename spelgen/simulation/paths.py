"""Desired motions of a controlled arm: sines, or random excitation trajectories."""

from __future__ import annotations

import numpy as np

from spelgen.arm.arm import Arm
from spelgen.errors import SettingsError, SpelgenError, collect
from spelgen.excitation.trajectory import SPEEDS, ExcitationTrajectory, Motion, MotionBounds
from spelgen.excitation.tuning import TUNING as EXCITATION
from spelgen.settings.settings import Settings
from spelgen.simulation.protocol import initial_range
from spelgen.simulation.tuning import TUNING as SIMULATION


def paths(arm: Arm, settings: Settings, t: np.ndarray) -> list[Motion]:
    """Return the desired motion of each trajectory, as `settings.tracking` specifies.

    The first motions are the same for any number of trajectories. Raises SettingsError if sines exceed a joint's range,
    or if a joint has no range.

    Args:
        arm: The arm.
        settings: `simulation` and `tracking` are used.
        t: Times (T,) [s].
    """
    count = settings.simulation.trajectories
    seeds = np.random.SeedSequence(settings.simulation.seed).spawn(count)
    randoms = list(map(np.random.default_rng, seeds))
    low, high = initial_range(arm, settings)
    if settings.tracking.paths == "excitation":
        # moderate: the middle of the ranges at moderate speeds, as for the first motion of an unknown arm
        middle, half = (low + high) / 2, SIMULATION.used_range * (high - low) / 2
        speeds = []
        for joint in arm.coordinates:
            speeds.append(min(SIMULATION.used_range * (joint.velocity or np.inf), SPEEDS[joint.kind]))
        bounds = MotionBounds(middle - half, middle + half, np.array(speeds))
        motions = ExcitationTrajectory(float(t[-1]), EXCITATION.fewest_harmonics, bounds)
        return [motions.motion(random.standard_normal(motions.size), t) for random in randoms]
    middle, amplitude = (low + high) / 2, _amplitude(arm, settings, low, high)
    drawn = [random.uniform(0, 2 * np.pi, len(middle)) for random in randoms]
    if settings.tracking.paths == "same":
        drawn = [drawn[0] + 2 * np.pi * number / count for number in range(count)]
    return [sines(middle, amplitude, settings.tracking.frequency, phase, t) for phase in drawn]


def sines(
    middle: np.ndarray, amplitude: np.ndarray | float, frequency: float, phase: np.ndarray, t: np.ndarray
) -> Motion:
    """Return the motion middle + amplitude sin(2 pi frequency t + phase), (T, n).

    Args:
        middle: Mean positions (n,) [rad; m].
        amplitude: Amplitudes (n,) [rad; m].
        frequency: Frequency of all joints [Hz].
        phase: Phases (n,) [rad].
        t: Times (T,) [s].
    """
    omega = 2 * np.pi * frequency
    angle = omega * t[:, None] + phase
    swing = amplitude * np.sin(angle)
    return Motion(t, middle + swing, amplitude * omega * np.cos(angle), -(omega**2) * swing)


def _amplitude(arm: Arm, settings: Settings, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return the amplitudes (n,) [rad; m] of sines within low..high, (n,) each; SettingsError if they exceed these."""
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
