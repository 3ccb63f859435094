"""Excitation trajectories, which are Fourier series from rest to rest within bounds, and approaches to their start.

Swevers et al., Optimal robot excitation and identification, IEEE T-RA 13:730 (1997).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil, cos, pi, sqrt

import numpy as np
import torch
from scipy.interpolate import BPoly
from torch import Tensor

from spelgen.excitation.bounds import MotionBounds
from spelgen.excitation.tuning import TUNING

# [1] Lower bound of the ratio of two maxima of a Fourier series: at the grid points, and at all times. The grid has
# `TUNING.grid` points per period of the highest harmonic. Source: Ehlich and Zeller, Math. Z. 86:41, 1964.
GRID_RATIO = cos(pi / TUNING.grid)


def motion_columns(joints: Sequence[str]) -> list[str]:
    """Return the columns of a file with a motion of the joints: t, and for each joint its q, qd and qdd."""
    return ["t", *(f"{quantity}_{joint}" for quantity in ("q", "qd", "qdd") for joint in joints)]


@dataclass(frozen=True, eq=False)
class Motion:
    """A motion of n joints at T times.

    Attributes:
        t: (T,) times [s], which start at 0.
        q: (T, n) positions [rad, m].
        qd: (T, n) velocities [rad/s, m/s].
        qdd: (T, n) accelerations [rad/s^2, m/s^2].
    """

    t: np.ndarray
    q: np.ndarray
    qd: np.ndarray
    qdd: np.ndarray

    def then(self, later: Motion) -> Motion:
        """Return this motion followed by `later`, a motion that begins at the last position of this motion."""
        second = later.t + self.t[-1], later.q, later.qd, later.qdd
        # The first sample of the later motion is omitted: it repeats the last position of this motion.
        pairs = zip((self.t, self.q, self.qd, self.qdd), second, strict=True)
        return Motion(*(np.concatenate([ours, theirs[1:]]) for ours, theirs in pairs))


def approach(
    start: np.ndarray, end: np.ndarray, speed: np.ndarray, acceleration: np.ndarray, sample_rate: float
) -> Motion:
    """Return the fastest motion from rest at `start` to rest at `end` by a polynomial of degree 5.

    All joints start and stop at the same times.

    Args:
        start, end: first and last positions, (n,) [rad, m].
        speed: largest speeds, (n,) [rad/s, m/s].
        acceleration: largest accelerations, (n,) [rad/s^2, m/s^2].
        sample_rate: approximate sample rate [Hz].
    """
    distance = end - start
    # The largest first and second derivatives of 10 s^3 - 15 s^4 + 6 s^5 for s in 0..1 are 1.875 and 10 / sqrt(3).
    by_speed = (1.875 * np.abs(distance) / speed).max()
    by_acceleration = np.sqrt(10 / sqrt(3) * np.abs(distance) / acceleration).max()
    duration = float(max(by_speed, by_acceleration))
    t = np.linspace(0.0, duration, ceil(duration * sample_rate) + 1)
    still = np.zeros_like(distance)
    # If `start` and `end` are equal, the motion is a single sample; the polynomial needs some duration > 0.
    curve = BPoly.from_derivatives([0.0, duration or 1.0], [[start, still, still], [end, still, still]])
    return Motion(t, curve(t), curve(t, 1), curve(t, 2))


@dataclass(frozen=True, eq=False)
class ExcitationTrajectory:
    """Parametrized motions of n joints: one period of Fourier series of H harmonics that keep given bounds.

    Any real parameters (size,) give a valid motion, so the design needs no constraints. The parameters of a joint are:

    - H sine and H cosine coefficients. Only their ratios are used: they give the shape of the motion.
    - The offset of the motion within the position range.
    - The reduction of the amplitude, relative to the largest amplitude within the bounds.

    Velocity and acceleration are zero at both ends. For this, the vector of sine coefficients is projected to be
    orthogonal to (1, 2, ..., H), and the vector of cosine coefficients to be orthogonal to (1, 4, ..., H^2).
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
        """Number of parameters of a motion: 2 H + 2 per joint, with the number H of harmonics."""
        return self.joints * (2 * self.harmonics + 2)

    def motion(self, parameters: np.ndarray, t: np.ndarray) -> Motion:
        """Return the motion for parameters (size,) at times t (T,) [s]."""
        q, qd, qdd = self.states(torch.from_numpy(parameters), torch.from_numpy(t)).numpy()
        return Motion(t, q, qd, qdd)

    def states(self, parameters: Tensor, t: Tensor) -> Tensor:
        """Return q, qd and qdd, (3, T, n), at times t (T,) [s]; parameters (size,): see the class.

        Positions, speeds and, if limited, accelerations are within `bounds` at all times. They are computed at grid
        points, with a safety factor: the maximum of a series of H harmonics is at most 1 / cos(pi / N) times its
        maximum on a grid with N points per period of the highest harmonic (Ehlich and Zeller, Math. Z. 86:41, 1964).
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
        # Any value of the amplitude parameter gives an amplitude between zero and the largest amplitude within the
        # bounds.
        amplitude = largest * (-self.amplitude_reduction(parameters)).exp()
        # Without offset, the motion is in amplitude * [middle - half, middle + half]. It is within the position range
        # [low, low + room] for offsets in an interval that starts at low - amplitude * (middle - half) and has the
        # width `free`, (n,). The tanh maps any value of the offset parameter into this interval.
        free = room - 2 * amplitude * half
        offset = low - amplitude * (middle - half) + free * (1 + offsets.tanh()) / 2
        q, qd, qdd = amplitude * self._signals(coefficients, t)
        return torch.stack([offset + q, qd, qdd])

    def amplitude_reduction(self, parameters: Tensor) -> Tensor:
        """Return -log(amplitude / largest amplitude within the bounds) per joint, (n,), for parameters (size,)."""
        return parameters.reshape(self.joints, -1)[:, -1].square() / 4

    def _coefficients(self, parameters: Tensor) -> tuple[Tensor, Tensor]:
        """Return the sine and cosine coefficients of the H harmonics, (2, H, n), and the offset parameters, (n,).

        The coefficients are projected so that the motion starts and ends at rest (see the class). Offset parameters are
        any real numbers; `states` maps them to offsets in rad or m. parameters: (size,), see the class.
        """
        rows = parameters.reshape(self.joints, 2 * self.harmonics + 2)
        sines_cosines = rows[:, :-2].reshape(self.joints, 2, self.harmonics).permute(1, 2, 0)
        k = self._numbers()
        at_rest = []
        for coefficients, power in zip(sines_cosines, (k, k**2), strict=True):
            along = power / power.norm()
            at_rest.append(coefficients - torch.outer(along, along @ coefficients))
        return torch.stack(at_rest), rows[:, -2]

    def _signals(self, coefficients: Tensor, t: Tensor) -> Tensor:
        """Return position, velocity and acceleration, (3, T, n), of Fourier series at times t (T,) [s].

        coefficients: sine and cosine coefficients, (2, H, n).
        """
        frequencies = self._numbers() * 2 * pi / self.duration  # frequencies: (H,) [rad/s]
        angles = torch.outer(t, frequencies)
        sine, cosine = angles.sin(), angles.cos()  # sine and cosine: (T, H)
        a, b = coefficients
        first, second = frequencies[:, None], (frequencies**2)[:, None]
        position = sine @ a + cosine @ b
        velocity = cosine @ (first * a) - sine @ (first * b)
        acceleration = -sine @ (second * a) - cosine @ (second * b)
        return torch.stack([position, velocity, acceleration])

    def _numbers(self) -> Tensor:
        """Return 1, 2, ..., H, the numbers of the harmonics, (H,)."""
        return torch.arange(1, self.harmonics + 1, dtype=torch.float64)
