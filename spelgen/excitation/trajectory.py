"""Make excitation trajectories: Fourier series that begin and end at rest and keep an arm's limits by construction.

Swevers et al., Optimal robot excitation and identification, IEEE T-RA 13:730 (1997).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import cos, pi

import numpy as np

from spelgen.arm.arm import Arm, Coordinate
from spelgen.errors import ArmError, SpelgenError, collect
from spelgen.settings.tuning.simulation import ExcitationTuning
from spelgen.urdf.robot import Joint

DENSITY = 40  # points of a grid for each harmonic
BETWEEN = cos(pi / DENSITY)  # of a series' largest value, what a grid shows at least
TUNING = ExcitationTuning()
# where the URDF names no limit, and for endless joints: [rad/s, m/s], and [rad, m] to both sides of 0
SPEEDS = {"revolute": TUNING.usual_speed, "prismatic": TUNING.usual_speed / 4}
REACHES = {"revolute": pi, "prismatic": 0.5}


@dataclass(frozen=True, eq=False)
class MotionBounds:
    """Hold what a motion must keep, each (n,): lowest and highest position, speed [rad, m, per second]."""

    low: np.ndarray
    high: np.ndarray
    speed: np.ndarray


def motion_bounds(
    arm: Arm, reach: float, speed: float, joints: Mapping[str, Joint] | None = None
) -> MotionBounds:
    """Return the arm's limits, of the range the middle part `reach`, of the velocity limits the part `speed`.

    joints: of the URDF, by name; then joints that follow others by <mimic> keep their limits too.
    Raises ArmError where a joint has no room between its limits.
    """
    limits: list[tuple[float, float, float]] = []
    errors: list[SpelgenError] = []
    for index, coordinate in enumerate(arm.coordinates):
        lowest, highest, fastest = _limits(index, arm, joints or {})
        limits.append((lowest, highest, fastest))
        if not lowest < highest:
            errors.append(ArmError(
                f"the limits {lowest:g} .. {highest:g}", element=f"joint {coordinate.name!r}",
                expected="room to move", do="correct them, or omit the joint by --joints",
            ))  # fmt: skip
    collect(errors)
    low, high, speeds = np.array(limits).T
    middle, half = (low + high) / 2, (high - low) / 2
    return MotionBounds(middle - reach * half, middle + reach * half, speed * speeds)


def _limits(index: int, arm: Arm, joints: Mapping[str, Joint]) -> tuple[float, float, float]:
    """Return lowest and highest position and largest speed of a coordinate."""
    coordinate = arm.coordinates[index]
    low, high = _range(coordinate)
    speed = coordinate.velocity or SPEEDS[coordinate.kind]
    for body in arm.bodies:
        if body.coordinate != index or body.name == coordinate.name or body.name not in joints:
            continue
        follower, factor = joints[body.name], float(body.multiplier)
        if not factor:
            continue
        if follower.type != "continuous" and follower.lower is not None and follower.upper is not None:
            ends = sorted((end - body.offset) / factor for end in (follower.lower, follower.upper))
            low, high = max(low, ends[0]), min(high, ends[1])
        if follower.velocity:
            speed = min(speed, follower.velocity / abs(factor))
    return low, high, speed


def _range(coordinate: Coordinate) -> tuple[float, float]:
    reach = REACHES[coordinate.kind]
    if coordinate.continuous or coordinate.lower is None or coordinate.upper is None:
        return -reach, reach
    return min(coordinate.lower, coordinate.upper), max(coordinate.lower, coordinate.upper)


@dataclass(frozen=True, eq=False)
class Motion:
    """Hold q (T, n) and its two derivatives at times t (T,), from 0 to the duration [s]."""

    t: np.ndarray
    q: np.ndarray
    qd: np.ndarray
    qdd: np.ndarray


@dataclass(frozen=True, eq=False)
class ExcitationTrajectory:
    """Give motions of n joints with H harmonics of one period; parameters (`size`,) choose one that keeps the bounds.

    The parameters of each joint: H sine and H cosine coefficients, whose common size is free, the offset (where in
    its range the joint moves), and how much of the largest amplitude that range and speed allow it gives away.
    Velocity and acceleration are zero at both ends: the sine coefficients are made orthogonal to (1, 2 .. H), the
    cosine ones to (1, 4 .. H^2).
    """

    duration: float
    harmonics: int
    bounds: MotionBounds

    @property
    def joints(self) -> int:
        """n."""
        return len(self.bounds.low)

    @property
    def size(self) -> int:
        """How many parameters."""
        return self.joints * (2 * self.harmonics + 2)

    def motion(self, parameters: np.ndarray, t: np.ndarray) -> Motion:
        """Return the motion of these parameters at these times (T,).

        The bounds hold at every time, not at these alone: between the points of a grid a series of H harmonics
        exceeds them by less than 1 / cos(pi / density) (Ehlich and Zeller, Math. Z. 86:41, 1964).
        """
        coefficients, offsets = self._coefficients(parameters)
        grid = self._signals(coefficients, np.linspace(0.0, self.duration, DENSITY * self.harmonics + 1))
        middle, half = (grid[0].max(axis=0) + grid[0].min(axis=0)) / 2, np.ptp(grid[0], axis=0) / 2 / BETWEEN
        low, high, fastest = middle - half, middle + half, np.abs(grid[1]).max(axis=0) / BETWEEN
        room = self.bounds.high - self.bounds.low
        # by construction, and not by penalty: every parameter vector is a motion that keeps the limits
        largest = np.minimum(room / (high - low), self.bounds.speed / fastest)
        size = largest * self.amplitude_fractions(parameters)
        free = room - size * (high - low)  # how far the whole motion can be moved
        start = self.bounds.low - size * low + free * (1 + np.tanh(offsets)) / 2
        q, qd, qdd = (size * x for x in self._signals(coefficients, t))
        return Motion(t, start + q, qd, qdd)

    def amplitude_fractions(self, parameters: np.ndarray) -> np.ndarray:
        """Return the part of its largest amplitude that each joint has, (n,)."""
        return np.exp(-(parameters.reshape(self.joints, -1)[:, -1] ** 2) / 4)

    def _coefficients(self, parameters: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return coefficients (2, H, n) of sines and cosines, and offsets (n,)."""
        rows = parameters.reshape(self.joints, 2 * self.harmonics + 2)
        sines_cosines = rows[:, :-2].reshape(self.joints, 2, self.harmonics).transpose(1, 2, 0)
        k = np.arange(1, self.harmonics + 1, dtype=float)
        at_rest = []
        for coefficients, power in zip(sines_cosines, (k, k**2), strict=True):
            along = power / np.linalg.norm(power)
            at_rest.append(coefficients - np.outer(along, along @ coefficients))
        return np.stack(at_rest), rows[:, -2]

    def _signals(self, coefficients: np.ndarray, t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return position, velocity and acceleration (T, n) of amplitude one."""
        frequencies = np.arange(1, self.harmonics + 1) * 2 * pi / self.duration  # angular
        sine, cosine = np.sin(t[:, None] * frequencies), np.cos(t[:, None] * frequencies)  # (T, H)
        a, b = coefficients
        first, second = frequencies[:, None], (frequencies**2)[:, None]
        return (
            sine @ a + cosine @ b,
            cosine @ (first * a) - sine @ (first * b),
            -sine @ (second * a) - cosine @ (second * b),
        )
