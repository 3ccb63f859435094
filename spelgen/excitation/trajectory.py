"""Excitation trajectories: Fourier series that start and end at rest and keep the limits of an arm by construction.

Swevers et al., Optimal robot excitation and identification, IEEE T-RA 13:730 (1997).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import cos, nan, pi

import numpy as np
import torch
from torch import Tensor

from spelgen.arm.arm import Chain
from spelgen.errors import ArmError, SpelgenError, collect
from spelgen.excitation.tuning import TUNING
from spelgen.urdf.robot import UrdfJoint

# Smallest ratio of the maximum of a series on the grid to its maximum over time.
GRID_RATIO = cos(pi / TUNING.grid)
# Speed limits of joints without a velocity limit [rad/s], [m/s].
SPEEDS = {"revolute": TUNING.revolute_speed, "prismatic": TUNING.prismatic_speed}


@dataclass(frozen=True, eq=False)
class MotionBounds:
    """Bounds of a motion, (n,) each: lowest and highest position [rad, m], speed, acceleration (by default none)."""

    low: np.ndarray
    high: np.ndarray
    speed: np.ndarray
    acceleration: np.ndarray | None = None

    def narrowed(self, factor: float) -> MotionBounds:
        """Return bounds with a fraction of the position ranges about the same middle."""
        middle, half = (self.low + self.high) / 2, factor * (self.high - self.low) / 2
        return replace(self, low=middle - half, high=middle + half)


def motion_bounds(
    arm: Chain,
    range_fraction: float,
    speed_fraction: float,
    joints: Mapping[str, UrdfJoint] | None = None,
    ranges: Mapping[str, tuple[float, float]] | None = None,
) -> MotionBounds:
    """Return the central fraction of the position ranges, and a fraction of the velocity limits.

    joints: of the URDF by name, so that <mimic> joints keep their own limits. ranges: of joints by name, in place of
    their limits; continuous joints without a range move by half a turn to both sides. Raises ArmError for a joint
    without a range, or whose limits are not increasing.
    """
    limits, speeds = np.zeros((len(arm.coordinates), 2)), np.zeros(len(arm.coordinates))
    for k, coordinate in enumerate(arm.coordinates):
        default = (-pi, pi) if coordinate.continuous else (nan, nan)
        limits[k] = sorted((ranges or {}).get(coordinate.name) or coordinate.limits or default)
        speeds[k] = coordinate.velocity or SPEEDS[coordinate.joint_type]
    for body in arm.bodies:
        k, factor = body.coordinate, float(body.multiplier)
        mimic = (joints or {}).get(body.name)
        if mimic is None or body.name == arm.coordinates[k].name or not factor:
            continue
        if mimic.type != "continuous" and mimic.lower is not None and mimic.upper is not None:
            low, high = sorted((end - body.offset) / factor for end in (mimic.lower, mimic.upper))
            limits[k] = max(low, limits[k, 0]), min(high, limits[k, 1])
        if mimic.velocity:
            speeds[k] = min(speeds[k], mimic.velocity / abs(factor))
    errors: list[SpelgenError] = []
    for coordinate, (low, high) in zip(arm.coordinates, limits, strict=True):
        if np.isnan(low):
            line = f"simulation: {{positions: {{{coordinate.name}: [LOWEST, HIGHEST]}}}}"
            errors.append(ArmError(
                "no position limits", element=f"joint {coordinate.name!r}", expected="a range to move in",
                do=f"write '{line}' into the robot's YAML",
            ))  # fmt: skip
        elif not low < high:
            errors.append(ArmError(
                f"the limits {low:g} .. {high:g}", element=f"joint {coordinate.name!r}",
                expected="room to move", do="correct them, or omit the joint by --joints",
            ))  # fmt: skip
    collect(errors)
    middle, half_range = limits.mean(axis=1), np.diff(limits)[:, 0] / 2
    half_range = range_fraction * half_range
    return MotionBounds(middle - half_range, middle + half_range, speed_fraction * speeds)


@dataclass(frozen=True, eq=False)
class Motion:
    """q, qd and qdd (T, n) at times t (T,) from 0 to the duration [s]."""

    t: np.ndarray
    q: np.ndarray
    qd: np.ndarray
    qdd: np.ndarray

    def then(self, later: Motion) -> Motion:
        """Return this motion and a later one, which begins at the last position of this one."""
        columns = [
            (self.t, self.t[-1] + later.t),
            (self.q, later.q),
            (self.qd, later.qd),
            (self.qdd, later.qdd),
        ]
        return Motion(*(np.concatenate([first, second[1:]]) for first, second in columns))


@dataclass(frozen=True, eq=False)
class ExcitationTrajectory:
    """A family of motions of n joints with H harmonics of one period, all of which keep the bounds.

    Any parameters (size,) are valid, so the design needs no constraints. The parameters of each joint are H sine and
    H cosine coefficients, of which only the ratios count, the offset of the motion in the range, and the reduction of
    the amplitude from the largest one that the bounds allow. Velocity and acceleration are zero at both ends: sine
    coefficients are projected to be orthogonal to (1, 2, ..., H), cosine coefficients to (1, 4, ..., H^2).
    """

    duration: float
    harmonics: int
    bounds: MotionBounds

    @property
    def joints(self) -> int:
        """Number of joints."""
        return len(self.bounds.low)

    @property
    def size(self) -> int:
        """Number of parameters."""
        return self.joints * (2 * self.harmonics + 2)

    def motion(self, parameters: np.ndarray, t: np.ndarray) -> Motion:
        """Return the motion for parameters (size,) at times t (T,) [s]."""
        q, qd, qdd = self.states(torch.from_numpy(parameters), torch.from_numpy(t)).numpy()
        return Motion(t, q, qd, qdd)

    def states(self, parameters: Tensor, t: Tensor) -> Tensor:
        """Return q, qd and qdd, (3, T, n), for parameters (size,) at times t (T,) [s].

        The bounds hold at all times: the maximum of a series of H harmonics is at most 1 / cos(pi / density) times its
        maximum on a grid with `density` points per harmonic (Ehlich and Zeller, Math. Z. 86:41, 1964).
        """
        coefficients, offsets = self._coefficients(parameters)
        points = torch.linspace(0.0, self.duration, TUNING.grid * self.harmonics + 1, dtype=torch.float64)
        positions, velocities, accelerations = self._signals(coefficients, points)
        highest, lowest = positions.amax(dim=0), positions.amin(dim=0)
        middle, half = (highest + lowest) / 2, (highest - lowest) / 2 / GRID_RATIO
        fastest = velocities.abs().amax(dim=0) / GRID_RATIO
        low, speed = torch.from_numpy(self.bounds.low), torch.from_numpy(self.bounds.speed)
        room = torch.from_numpy(self.bounds.high) - low
        largest = torch.minimum(room / (2 * half), speed / fastest)
        if self.bounds.acceleration is not None:
            strongest = accelerations.abs().amax(dim=0) / GRID_RATIO
            largest = torch.minimum(largest, torch.from_numpy(self.bounds.acceleration) / strongest)
        amplitude = largest * (-self.amplitude_reduction(parameters)).exp()
        free = room - 2 * amplitude * half  # range of the offset
        offset = low - amplitude * (middle - half) + free * (1 + offsets.tanh()) / 2
        q, qd, qdd = amplitude * self._signals(coefficients, t)
        return torch.stack([offset + q, qd, qdd])

    def amplitude_reduction(self, parameters: Tensor) -> Tensor:
        """Return -log(amplitude / largest amplitude) of each joint, (n,), for parameters (size,)."""
        return parameters.reshape(self.joints, -1)[:, -1].square() / 4

    def _coefficients(self, parameters: Tensor) -> tuple[Tensor, Tensor]:
        """Return the coefficients (2, H, n) of sines and cosines, and of offsets (n,), from parameters (size,)."""
        rows = parameters.reshape(self.joints, 2 * self.harmonics + 2)
        sines_cosines = rows[:, :-2].reshape(self.joints, 2, self.harmonics).permute(1, 2, 0)
        k = self._numbers()
        at_rest = []
        for coefficients, power in zip(sines_cosines, (k, k**2), strict=True):
            along = power / power.norm()
            at_rest.append(coefficients - torch.outer(along, along @ coefficients))
        return torch.stack(at_rest), rows[:, -2]

    def _signals(self, coefficients: Tensor, t: Tensor) -> Tensor:
        """Return position, velocity and acceleration, (3, T, n), of coefficients (2, H, n) at times t (T,)."""
        frequencies = self._numbers() * 2 * pi / self.duration  # angular
        angles = torch.outer(t, frequencies)
        sine, cosine = angles.sin(), angles.cos()  # (T, H)
        a, b = coefficients
        first, second = frequencies[:, None], (frequencies**2)[:, None]
        position = sine @ a + cosine @ b
        velocity = cosine @ (first * a) - sine @ (first * b)
        acceleration = -sine @ (second * a) - cosine @ (second * b)
        return torch.stack([position, velocity, acceleration])

    def _numbers(self) -> Tensor:
        """Return 1, ..., H, (H,)."""
        return torch.arange(1, self.harmonics + 1, dtype=torch.float64)
