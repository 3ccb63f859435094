"""Tuned numbers of the derivation: of exact geometry, of the structure, and of what is said about it."""

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


@dataclass(frozen=True)
class CertificateTuning:
    """Hold how much of closed forms is written, and what numbers of a check count as rounding."""

    readable_terms: int = 40  # of an entry that a person reads among others: three lines of a terminal
    writable_terms: int = 3000  # of an entry that a program reads, or a person who asks for it alone
    budget: int = 2_000_000  # multiplications of terms for all entries of an arm, about 2 s
    rounding: float = 1e-12  # of its scale: a smaller number of a check is rounding; what is measured is told
    form_rounding: float = 1e-6  # the same for the smallest form, whose long fractions are doubles
    fine: float = 1e-3  # an arm with smaller nonzero numbers may have products that vanish in rounding
    frame_rounding: float = 1e-9  # [rad, m] per joint: dropped offsets, and composed rotations of 1e-11 each


@dataclass(frozen=True)
class StructureTuning:
    """Hold what decides how far the structure is searched, and the sizes a model starts with."""

    all_subsets_up_to: int = 8  # joints: longer arms have outputs of contiguous ranges only (2^n sets else)
    spare_samples: int = 4  # beyond the dimension a span can have: they would show a larger one
    points: int = 512  # configurations over the workspace that sizes are means of
    least_size: float = 0.05  # of the entries an output enters: the least it is expected to move
    least_sensitivity: float = 0.02  # of the largest: a joint that nominally matters less is still seen
    default_gyration: float = 0.1  # [m] of the one-kilogram ball that stands for a link without inertial
    least_pseudo_eigenvalue: float = 1e-4  # of the largest: to it those of an impossible body are raised
