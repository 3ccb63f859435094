"""How `spelgen compare` trains on one robot's logs."""

from __future__ import annotations

from pydantic import Field

from spelgen.settings.values import Count, Group, NonNegative, Positive, Whole


class PublishedFigures(Group):
    """What a publication reports of one preset on this robot; None where it gives no figure.

    train_loss, test_loss, prediction_loss: squared errors of predicted windows, summed over the joints. velocity,
    position: mean squared errors over 1 s, likewise. step_seconds: of a training step, on its authors' machine.
    """

    parameters: Count | None = None
    step_seconds: Positive | None = None
    train_loss: Positive | None = None
    test_loss: Positive | None = None
    prediction_loss: Positive | None = None
    velocity: Positive | None = None
    position: Positive | None = None


class ComparisonSettings(Group):
    """How `spelgen compare` trains every preset on this robot's simulated logs.

    first: only so much of each training trajectory is trained on [s]; None: all. steps: of training, at least.
    momentum_steps: before these. weight_decay: of every preset; None: as in training. seeds: runs of each preset.
    width, depth: of the hidden layers. published: figures to stand beside what is measured, by preset.
    """

    first: Positive | None = None
    steps: Count = 1500
    momentum_steps: Whole = 1000
    weight_decay: NonNegative | None = None
    seeds: Count = 5
    width: Count = 64
    depth: Count = 2
    published: dict[str, PublishedFigures] = Field(default_factory=dict)
