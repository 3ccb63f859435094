"""Which joints the units of a network read, layer by layer."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np


def hidden_units(
    outputs: Sequence[tuple[int, ...]], width: int, fewest: int = 1
) -> tuple[tuple[tuple[int, ...], int], ...]:
    """Return how many units of a hidden layer may read which joints, for outputs that read these joints.

    A hidden layer has ``width`` units, shared out in proportion to how many outputs read the same joints, ``fewest`` or
    more for each such group.
    """
    counts = Counter(outputs)
    groups = sorted(counts, key=lambda joints: (len(joints), joints))
    ideal = width * np.array([counts[joints] for joints in groups]) / len(outputs)
    units = np.maximum(fewest, ideal.round().astype(int))
    # rounding may have added or removed a unit or two: the groups that gained most give, those that lost most take
    while units.sum() > width and units.max() > fewest:
        gains = np.where(units > fewest, units - ideal, -np.inf)
        units[gains.argmax()] -= 1
    while units.sum() < width:
        units[(ideal - units).argmax()] += 1
    return tuple(zip(groups, units.tolist(), strict=True))
