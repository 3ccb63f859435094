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
