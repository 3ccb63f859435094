"""Constants of closed forms and of their verification."""

from __future__ import annotations

from dataclasses import dataclass


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


TUNING = CertificateTuning()
