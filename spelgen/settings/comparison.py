"""Settings of `spelgen compare` for one robot."""

from __future__ import annotations

from pydantic import Field

from spelgen.settings.values import Count, Group, NonNegative, Positive, Whole


class PublishedFigures(Group):
    """Figures of one preset on this robot in a publication; without a value: not published.

    Attributes:
        parameters: Number of trained parameters.
        step_seconds: Duration of a training step on the authors' machine [s].
        train_loss: Squared error of predicted training windows, summed over the joints.
        test_loss: Squared error of predicted test windows, summed over the joints.
        prediction_loss: Squared error of long predictions, summed over the joints.
        velocity: Mean squared error of the velocity over 1 s, summed over the joints.
        position: Mean squared error of the position over 1 s, summed over the joints.
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

    Attributes:
        first: Duration of the initial part of each training motion that is used; default: the whole motion [s].
        steps: Smallest number of training steps on predicted windows.
        momentum_steps: Number of training steps on the weak form before these.
        weight_decay: Weight decay of all presets; default: as in `training`.
        seeds: Number of runs of each preset.
        width: Units per hidden layer.
        depth: Number of hidden layers.
        published: Published figures, by preset.
    """

    first: Positive | None = None
    steps: Count = 1500
    momentum_steps: Whole = 1000
    weight_decay: NonNegative | None = None
    seeds: Count = 5
    width: Count = 64
    depth: Count = 2
    published: dict[str, PublishedFigures] = Field(default_factory=dict)
