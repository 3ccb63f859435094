"""Settings of `spelgen compare` for one robot."""

from __future__ import annotations

from pydantic import Field

from spelgen.settings.values import Count, Group, NonNegative, Positive, Whole


class PublishedFigures(Group):
    """Figures of one preset on this robot in a publication; None: not published.

    train_loss, test_loss, prediction_loss: squared errors of predicted windows, summed over joints [rad, m, s].
    velocity, position: mean squared errors over 1 s, summed over joints. step_seconds: time of a training step on the
    authors' machine [s].
    """

    parameters: Count | None = None
    step_seconds: Positive | None = None
    train_loss: Positive | None = None
    test_loss: Positive | None = None
    prediction_loss: Positive | None = None
    velocity: Positive | None = None
    position: Positive | None = None


class ComparisonSettings(Group):
    """Training of all presets on simulated logs of this robot by `spelgen compare`.

    first: duration of the part of each training motion that is trained on [s]; None: all. steps: smallest number of
    training steps on predicted windows. momentum_steps: steps on the weak form before them. weight_decay: of all
    presets; None: as in `training`. seeds: number of runs of each preset. width, depth: of hidden layers. published:
    published figures, by preset.
    """

    first: Positive | None = None
    steps: Count = 1500
    momentum_steps: Whole = 1000
    weight_decay: NonNegative | None = None
    seeds: Count = 5
    width: Count = 64
    depth: Count = 2
    published: dict[str, PublishedFigures] = Field(default_factory=dict)
