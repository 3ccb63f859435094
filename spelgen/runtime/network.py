"""What a part of a model needs of the network that it is given, and which joints the layers read."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any, Protocol

from torch import Tensor


class Network(Protocol):
    """Learned functions y of an encoding, each of its own joints, with derivatives written out."""

    def prepare(self, output_map: Tensor, offset: Tensor) -> Any:
        """The weights made ready for many states, for offset + output_map y in place of y."""

    def __call__(self, encoded: Tensor, layers: Any) -> tuple[Tensor, Any]:
        """offset + output_map y, (..., rows); and residuals, which ``vjp`` and ``jvp`` need."""

    def vjp(self, residuals: Any, cotangent: Tensor) -> Tensor:
        """cotangent, (..., rows), times d/d encoded."""

    def jvp(self, residuals: Any, tangent: Tensor) -> Tensor:
        """d/d encoded times the encoding's tangent, (..., rows)."""


def unit_joints(
    outputs: Sequence[Sequence[int]], width: int, depth: int, least: int = 1
) -> tuple[tuple[frozenset[int], ...], ...]:
    """The joints that each unit may read, layer by layer: ``depth`` hidden layers, then the outputs.

    A hidden layer has ``width`` units, shared out in proportion to how many outputs read the same
    joints, ``least`` or more for each such group.
    """
    counts = Counter(tuple(joints) for joints in outputs)
    groups = sorted(counts, key=lambda each: (len(each), each))
    ideal = [width * counts[joints] / len(outputs) for joints in groups]
    units = [max(least, round(size)) for size in ideal]
    # rounding may have taken or left a unit or two: those who gained most give, who lost most take
    while sum(units) > width and max(units) > least:
        gained = [
            number - size if number > least else -width for number, size in zip(units, ideal, strict=True)
        ]
        units[gained.index(max(gained))] -= 1
    while sum(units) < width:
        lost = [size - number for number, size in zip(units, ideal, strict=True)]
        units[lost.index(max(lost))] += 1
    hidden = tuple(frozenset(g) for g, number in zip(groups, units, strict=True) for _ in range(number))
    return (*((hidden,) * depth), tuple(frozenset(joints) for joints in outputs))
