"""Constants of comparisons."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class ComparisonTuning:
    """Measurements of the runs of `compare`."""

    # [1] Largest number of windows on which a model is measured, evenly spread.
    windows: int = 512
    # [1] Training steps whose median time is reported: other programs may run at the same time.
    timed_steps: int = 9
    # [s] Time over which trajectories are predicted, as in the paper.
    horizon: float = 1.0
    # [kg] Links of at most this mass keep their inertials.
    massless: float = 1e-9
    # [1] Seed of the perturbed inertials, the same in every call.
    seed: int = 0


TUNING = ComparisonTuning()
