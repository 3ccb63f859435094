"""Constants of the exact geometry."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class GeometryTuning:
    """Hold what decides which exact number a rounded one of a URDF stands for."""

    # [rad] from pi/12, pi/8, pi/5: 0.26, 0.39, 0.63 are as often meant as they are
    fine_tolerance: float = 2e-5
    fine_divisors: tuple[int, ...] = (12, 8, 5)  # of pi: the special angles on CAD drawings of the 189 arms
    offset_noise: float = 1e-9  # [m] below it an offset is 0: what composed rotations leave
    axis_noise: float = 1e-3  # of a unit axis: a component below it is 0, as CAD exporters print three digits
    notable: float = 1e-9  # [rad, 1] a smaller change of an angle or axis is not worth a remark
    # of a rotation's element, of the largest moment: smaller is rounding and means 0
    zero_noise: float = 1e-12
    rotation_error: float = 1e-11  # [rad] of a rational rotation: thousands of times below any calibration
    denominators: tuple[int, ...] = (10**7, 10**10, 10**13)  # tried in turn, the shortest fractions first
    eighth: float = 0.7  # [rad] just below pi/4: at an edge of an eighth no usual angle lies
    most_bits: int = 4096  # of a denominator: exact arithmetic on longer ones takes hours (a hostile file)
    # [rad] between two axes that are meant to be parallel, whatever rounding made of them
    parallel: float = 1e-2


TUNING = GeometryTuning()
