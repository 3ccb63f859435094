"""The joints that each unit of a network may depend on: each output depends only on its own joints."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence

import torch
from torch import Tensor

from spelgen.runtime.parts import Rows
from spelgen.runtime.rows import Joint, vector


def hidden_units(outputs: Sequence[tuple[int, ...]], width: int, min_units: int) -> list[tuple[int, ...]]:
    """Return the joints of each unit of a hidden layer.

    Outputs that depend on the same joints form a group. The ``width`` units are divided among the groups in
    proportion to their numbers of outputs, with at least ``min_units`` for each group.
    """
    counts = Counter(outputs)
    groups = sorted(counts, key=lambda joints: (len(joints), joints))
    ideal = [width * counts[group] / len(outputs) for group in groups]
    units = [max(min_units, round(share)) for share in ideal]
    index = range(len(groups))
    # after rounding the sum may differ from the width: the largest differences are corrected first
    while sum(units) > width and max(units) > min_units:
        units[max(index, key=lambda k: units[k] - ideal[k] if units[k] > min_units else -width)] -= 1
    while sum(units) < width:
        units[max(index, key=lambda k: ideal[k] - units[k])] += 1
    return [group for group, count in zip(groups, units, strict=True) for _ in range(count)]


def joint_masks(
    joints: Sequence[Joint],
    scales: Rows,
    outputs: Sequence[Sequence[str]],
    width: int,
    depth: int,
    min_units: int,
) -> Iterator[Tensor]:
    """Yield the factors on the weights of each layer, (units, inputs).

    A factor is 0 where the input depends on a joint that the unit must not depend on; the factors of the
    first layer scale the inputs.

    Args:
        joints: of the arm.
        scales: factors of the inputs, a row (n,) for each input per joint.
        outputs: names of the joints that each output depends on.
        width: units of a hidden layer.
        depth: number of hidden layers.
        min_units: smallest number of units for outputs that depend on the same joints.
    """
    number = {joint.name: index for index, joint in enumerate(joints)}
    numbers = [tuple(number[name] for name in names) for names in outputs]
    hidden = [hidden_units(numbers, width, min_units)] * depth
    below = [{joint} for row in scales for joint in range(len(row))]
    scale = torch.cat([vector(row) for row in scales])
    for layer in [*hidden, numbers]:
        units = [set(unit) for unit in layer]
        yield scale * torch.stack([vector(lower <= unit for lower in below) for unit in units])
        below, scale = units, torch.ones(len(units), dtype=torch.float64)
