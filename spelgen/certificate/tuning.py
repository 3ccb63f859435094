"""Constants of closed forms and of their verification."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class CertificateTuning:
    """Limits of the length of closed forms, and bounds of rounding errors in a verification."""

    # [1] Largest number of terms of an entry that is printed together with others: three lines of a terminal.
    readable_terms: int = 40
    # [1] Digits of decimals in formulas that are read.
    digits: int = 12
    # [1] Largest number of terms of a Python sum with operators; longer sums are one call, as parsers nest operators.
    nested_terms: int = 20
    # [1] Largest number of terms of an entry in a file for programs, or of a single requested entry.
    writable_terms: int = 3000
    # [1] Largest number of multiplications of terms for all entries of an arm, about 2 s.
    budget: int = 2_000_000
    # [1] Random configurations at which relations between axes are tested exactly.
    configurations: int = 2
    # [1] Bound of numerators and denominators of random rational positions.
    grid: int = 10**6
    # [1] Samples of a verification in addition to the largest possible rank: they would reveal a larger rank.
    spare_samples: int = 6
    # [1] A number of a check below this fraction of its scale is rounding; measured differences are reported.
    rounding: float = 1e-12
    # [1] Bound of rounding errors of the smallest form, whose long fractions are evaluated in double precision.
    form_rounding: float = 1e-6
    # [1] Relative size of a nonzero number below which its products may vanish in rounding errors.
    fine: float = 1e-3
    # [rad, m] Allowed difference of frames per joint: dropped offsets, and composed rotations of 1e-11 each.
    frame_rounding: float = 1e-9


TUNING = CertificateTuning()
