"""How `spelgen compare` trains on one robot's logs."""

from __future__ import annotations

from spelgen.settings.values import Count, Group, NonNegative, Positive, Whole


class ComparisonSettings(Group):
    """How `spelgen compare` trains every preset on this robot's simulated logs.

    first: only so much of each training trajectory is trained on [s]; None: all. steps: of training, at least.
    momentum_steps: before these. weight_decay: of every preset; None: as in training. seeds: runs of each preset.
    width, depth: of the hidden layers.
    """

    first: Positive | None = None
    steps: Count = 1500
    momentum_steps: Whole = 1000
    weight_decay: NonNegative | None = None
    seeds: Count = 5
    width: Count = 64
    depth: Count = 2
