"""Defaults of `spelgen train` for one robot."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from spelgen.settings.values import Count, Group, NonNegative, Number, Positive, Whole


class TrainingSettings(Group):
    """Defaults of `spelgen train`; command-line flags override them.

    objective: what is fitted: the torque (the default of closed-form models) or predicted windows.
    window: samples predicted together. stride: samples from the start of one window to the next.
    every: samples from one sample of a window to the next; None: as many as filtered logs can spare.
    batch: windows per step. epochs: passes over all windows, at most.
    patience: epochs without a better validation loss before stopping.
    momentum_steps: steps on the weak form (see `momentum_loss`) before windows are predicted.
    prior: weight of staying near the URDF's own M and gravity (see `Prior`); 0: none.
    optimiser: AdamW on batches or L-BFGS on all windows at once; None: L-BFGS where these are few.
    weight_decay: of AdamW, or the weight of L-BFGS's penalty; None: what suits the optimiser.
    substeps: integrator steps per sample interval; None: as many as the robot needs.
    validation_fraction: part of the training trajectories held out to watch the validation loss.
    """

    objective: Literal["torque", "momentum", "rollout"] | None = None
    momentum_steps: Whole = 2000
    prior: NonNegative = 1.0
    window: Annotated[Count, Field(ge=2)] = 5
    stride: Count = 1
    every: Count | None = None
    epochs: Count = 400
    batch: Count = 256
    learning_rate: Positive = 1e-3
    weight_decay: NonNegative | None = None
    optimiser: Literal["adamw", "lbfgs"] | None = None
    substeps: Count | None = None
    validation_fraction: Annotated[Number, Field(gt=0, lt=1)] = 0.25
    patience: Count = 60
    seed: Whole = 0
