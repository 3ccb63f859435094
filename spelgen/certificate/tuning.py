"""Constants of closed forms and of their verification."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class CertificateTuning:
    """How much of the closed forms is written, and which numbers of a verification count as rounding."""

    # [1] Terms of an entry that is printed among others: three lines of a terminal.
    readable_terms: int = 40
    # [1] Digits of decimals in formulas that are read.
    digits: int = 12
    # [1] Terms of a sum in Python that are added by operators; longer sums are one call, as parsers nest operators.
    nested_terms: int = 20
    # [1] Terms of an entry that a program reads, or that is requested by itself.
    writable_terms: int = 3000
    # [1] Multiplications of terms for all entries of an arm, about 2 s.
    budget: int = 2_000_000
    # [1] Random configurations at which relations between axes are tested exactly.
    configurations: int = 2
    # [1] Bound of numerators and denominators of random rational positions.
    grid: int = 10**6
    # [1] Samples of a verification in addition to the largest possible rank: they would reveal a larger rank.
    spare_samples: int = 6
    # [1] A number of a check below this fraction of its scale is rounding; measured differences are reported.
    rounding: float = 1e-12
    # [1] The same bound for the smallest form, whose long fractions are evaluated in double precision.
    form_rounding: float = 1e-6
    # [1] An arm with smaller nonzero numbers may have products that vanish in rounding.
    fine: float = 1e-3
    # [rad, m] Allowed difference of frames per joint: dropped offsets, and composed rotations of 1e-11 each.
    frame_rounding: float = 1e-9


TUNING = CertificateTuning()
