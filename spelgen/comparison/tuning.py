"""Constants of comparisons."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class ComparisonTuning:
    """Numbers that decide how `compare` measures its runs."""

    windows: int = 512  # at most, evenly spread, that a model is measured on
    timed_steps: int = 9  # of training, whose median is told: other programs run beside
    horizon: float = 1.0  # [s] over which trajectories are predicted, as in the paper
    massless: float = 1e-9  # [kg] links of no more than this keep their inertials
    seed: int = 0  # of the wrong inertials, the same in every call


TUNING = ComparisonTuning()
