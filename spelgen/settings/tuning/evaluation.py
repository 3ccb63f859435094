"""The numbers that decide how models are judged."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class EvaluationTuning:
    """The numbers that evaluation, baselines and the verdict go by."""

    observed_past: float = 0.1
    """[s] that the momentum observer runs before a prediction (measured: 0.2 and 0.3 s are no better, UR10e)."""
    observer_time_constant: float = 0.05
    """[s] 1 / K of the momentum observer (measured: 0.02 to 0.1 s differ by 3 %, UR10e)."""

    most_substeps: int = 16
    """[] of a baseline between samples; a power of two."""
    shortest_step: float = 1e-3
    """[s] of a baseline: shorter ones are for dynamics that leave all bounds."""
    explicit_tolerance: float = 2e-3
    """[] of a baseline's own error, what twice as many steps of RK4 may change."""
    implicit_tolerance: float = 2e-2
    """[] the same of the Rosenbrock method, which has order two."""
    probed_windows: int = 16
    """[] that say in which steps a baseline is integrated."""
