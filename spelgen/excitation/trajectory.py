"""Make excitation trajectories: Fourier series that begin and end at rest and keep an arm's limits by construction.

Swevers et al., Optimal robot excitation and identification, IEEE T-RA 13:730 (1997).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import cos, nan, pi

import numpy as np
import torch
from torch import Tensor

from spelgen.arm.arm import Arm
from spelgen.errors import ArmError, SpelgenError, collect
from spelgen.excitation.tuning import TUNING
from spelgen.urdf.robot import Joint

BETWEEN = cos(pi / TUNING.grid)  # of a series' largest value, what a grid shows at least
# [rad/s, m/s] of joints without a velocity limit
SPEEDS = {"revolute": TUNING.usual_speed, "prismatic": TUNING.sliding_speed}


@dataclass(frozen=True, eq=False)
class MotionBounds:
    """Hold what a motion must keep, each (n,): lowest and highest position, speed [rad, m, per second]."""

    low: np.ndarray
    high: np.ndarray
    speed: np.ndarray


def motion_bounds(
    arm: Arm,
    reach: float,
    speed: float,
    joints: Mapping[str, Joint] | None = None,
    ranges: Mapping[str, tuple[float, float]] | None = None,
) -> MotionBounds:
    """Return the arm's limits, of the range the middle part `reach`, of the velocity limits the part `speed`.

    joints: of the URDF, by name; then joints that follow others by <mimic> keep their limits too.
    ranges: of joints by name, in place of their limits; continuous joints without one use half a turn to both sides.
    Raises ArmError if a joint has no range, or no room in it.
    """
    limits, speeds = np.zeros((len(arm.coordinates), 2)), np.zeros(len(arm.coordinates))
    for k, coordinate in enumerate(arm.coordinates):
        default = (-pi, pi) if coordinate.continuous else (nan, nan)
        limits[k] = sorted((ranges or {}).get(coordinate.name) or coordinate.limits or default)
        speeds[k] = coordinate.velocity or SPEEDS[coordinate.kind]
    for body in arm.bodies:
        k, factor = body.coordinate, float(body.multiplier)
        follower = (joints or {}).get(body.name)
        if follower is None or body.name == arm.coordinates[k].name or not factor:
            continue
        if follower.type != "continuous" and follower.lower is not None and follower.upper is not None:
            low, high = sorted((end - body.offset) / factor for end in (follower.lower, follower.upper))
            limits[k] = max(low, limits[k, 0]), min(high, limits[k, 1])
        if follower.velocity:
            speeds[k] = min(speeds[k], follower.velocity / abs(factor))
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
    return MotionBounds(middle - reach * half_range, middle + reach * half_range, speed * speeds)


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
        """Return the motion of these parameters at these times (T,)."""
        q, qd, qdd = self.states(torch.from_numpy(parameters), torch.from_numpy(t)).numpy()
        return Motion(t, q, qd, qdd)

    def states(self, parameters: Tensor, t: Tensor) -> Tensor:
        """Return q, qd and qdd at these times (T,), (3, T, n).

        The bounds hold at every time, not at these alone: between the points of a grid a series of H harmonics
        exceeds them by less than 1 / cos(pi / density) (Ehlich and Zeller, Math. Z. 86:41, 1964).
        """
        coefficients, offsets = self._coefficients(parameters)
        points = torch.linspace(0.0, self.duration, TUNING.grid * self.harmonics + 1, dtype=torch.float64)
        positions, velocities, _ = self._signals(coefficients, points)
        highest, lowest = positions.amax(dim=0), positions.amin(dim=0)
        middle, half = (highest + lowest) / 2, (highest - lowest) / 2 / BETWEEN
        fastest = velocities.abs().amax(dim=0) / BETWEEN
        low, speed = torch.from_numpy(self.bounds.low), torch.from_numpy(self.bounds.speed)
        room = torch.from_numpy(self.bounds.high) - low
        # by construction, and not by penalty: every parameter vector is a motion that keeps the limits
        largest = torch.minimum(room / (2 * half), speed / fastest)
        size = largest * (-self.given_away(parameters)).exp()
        free = room - 2 * size * half  # how far the whole motion can be moved
        start = low - size * (middle - half) + free * (1 + offsets.tanh()) / 2
        q, qd, qdd = size * self._signals(coefficients, t)
        return torch.stack([start + q, qd, qdd])

    def given_away(self, parameters: Tensor) -> Tensor:
        """Return minus the logarithm of the part of its largest amplitude that each joint has, (n,)."""
        return parameters.reshape(self.joints, -1)[:, -1].square() / 4

    def _coefficients(self, parameters: Tensor) -> tuple[Tensor, Tensor]:
        """Return coefficients (2, H, n) of sines and cosines, and offsets (n,)."""
        rows = parameters.reshape(self.joints, 2 * self.harmonics + 2)
        sines_cosines = rows[:, :-2].reshape(self.joints, 2, self.harmonics).permute(1, 2, 0)
        k = self._numbers()
        at_rest = []
        for coefficients, power in zip(sines_cosines, (k, k**2), strict=True):
            along = power / power.norm()
            at_rest.append(coefficients - torch.outer(along, along @ coefficients))
        return torch.stack(at_rest), rows[:, -2]

    def _signals(self, coefficients: Tensor, t: Tensor) -> Tensor:
        """Return position, velocity and acceleration (3, T, n) of amplitude one."""
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
        """Return 1 .. H."""
        return torch.arange(1, self.harmonics + 1, dtype=torch.float64)
