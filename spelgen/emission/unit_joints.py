"""Which joints the units of a network read, layer by layer."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence


def hidden_units(
    outputs: Sequence[tuple[int, ...]], width: int, fewest: int = 1
) -> tuple[tuple[int, ...], ...]:
    """Return the joints that each unit of a hidden layer may read, for outputs that read these joints.

    A hidden layer has ``width`` units, shared out in proportion to how many outputs read the same joints, ``least`` or
    more for each such group.
    """
    counts = Counter(outputs)
    groups = sorted(counts, key=lambda joints: (len(joints), joints))
    ideal = [width * counts[joints] / len(outputs) for joints in groups]
    units = [max(fewest, round(size)) for size in ideal]
    # rounding may have added or removed a unit or two: the groups that gained most give, those that lost most take
    while sum(units) > width and max(units) > fewest:
        gains = [number - size for number, size in zip(units, ideal, strict=True)]
        reducible = [k for k, number in enumerate(units) if number > fewest]
        units[max(reducible, key=lambda k: gains[k])] -= 1
    while sum(units) < width:
        losses = [size - number for number, size in zip(units, ideal, strict=True)]
        units[losses.index(max(losses))] += 1
    layer: list[tuple[int, ...]] = []
    for joints, number in zip(groups, units, strict=True):
        layer += [joints] * number
    return tuple(layer)
