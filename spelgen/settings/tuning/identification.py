"""Hold the tuned numbers of least squares on logs."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class IdentificationTuning:
    """Numbers that decide which samples least squares gets, and how it judges what it found."""

    sample_rate: float = (
        100.0  # [Hz] of the common grid: twelve times the low-pass, as in the published protocols
    )
    moving: float = 0.02  # [rad/s, m/s] samples at which every joint is slower say nothing of dynamics
    shortest_piece: float = 1.0  # [s] shorter pieces are all filter transient
