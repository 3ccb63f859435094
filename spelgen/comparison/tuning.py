"""Constants of the measurements that `spelgen compare` takes of trained models."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class ComparisonTuning:
    """Constants of `spelgen compare`."""

    # Largest number of windows that a loss is measured on; more windows are subsampled evenly.
    windows: int = 512
    # Number of timed training steps. Their median is used, because other programs run at the same time.
    timed_steps: int = 5
    # Time over which motions are predicted [s], as in Wang et al., Sci Rep 15:33179 (2025).
    horizon: float = 1.0
    # Fraction of the trajectories that is held out for testing if the logs have no test.* files.
    held_out: float = 0.25
    # The other constants are used only to estimate the time of a comparison; measured with robots/two_link.urdf.
    # Time of the measurements of a run after training [s].
    measuring: float = 10.0
    # Time of a momentum step, which solves no differential equation, relative to a step on predicted windows.
    momentum_cost: float = 0.5
    # Time of a run on logs [s] as long as no run of this arm and preset is finished.
    run_on_logs: float = 60.0
