"""Constants of the exact geometry."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class GeometryTuning:
    """Tolerances for the exact values that rounded numbers of a URDF represent."""

    # [rad] Distance to a multiple of pi/12, pi/8 or pi/5 within which an angle is rounded to it. It is small because
    # 0.26, 0.39 and 0.63 also occur as exact values.
    fine_tolerance: float = 2e-5
    # [1] Divisors of pi for these multiples: the special angles on the CAD drawings of 189 arms.
    fine_divisors: tuple[int, ...] = (12, 8, 5)
    # [m] An offset below this bound is 0: composed rotations have rounding errors of this size.
    offset_noise: float = 1e-9
    # [1] A component of a unit axis below this bound is 0: CAD exporters print three digits.
    axis_noise: float = 1e-3
    # [rad, 1] A change of an angle or of an axis below this bound is not reported.
    notable: float = 1e-9
    # [1] An element of a rotation, or a moment divided by the largest moment, below this bound is rounding and means
    # 0.
    zero_noise: float = 1e-12
    # [rad] Largest error of a rational rotation: thousands of times below the accuracy of any calibration.
    rotation_error: float = 1e-11
    # [1] Bounds of denominators, tried in turn so that the shortest fractions are found first.
    denominators: tuple[int, ...] = (10**7, 10**10, 10**13)
    # [rad] Start of the sectors of a quarter turn into which angles are sorted, just below pi/4: no common angle lies
    # at an edge.
    eighth: float = 0.7
    # [1] Largest number of bits of a denominator: exact arithmetic on longer ones takes hours (untrusted input).
    max_bits: int = 4096
    # [rad] Largest angle between two axes that are meant to be parallel, rounding included.
    parallel: float = 1e-2


TUNING = GeometryTuning()
