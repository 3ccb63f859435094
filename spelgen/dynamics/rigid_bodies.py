"""The bodies of an arm as the runtime's own chain."""

from __future__ import annotations

from typing import Any

from spelgen.arm.arm import Arm
from spelgen.runtime.body_chain import BodyChain
from spelgen.runtime.parts import Row


def body_chain(arm: Arm) -> BodyChain:
    """Return how the arm's bodies may move, for q (..., n) [rad; m]."""
    rows: list[tuple[Any, ...]] = []
    for body in arm.bodies:
        placement = [(*_row(row), float(x)) for row, x in zip(body.rotation, body.translation, strict=True)]
        is_revolute, ratio = body.kind == "revolute", float(body.multiplier)
        rows.append((body.parent, body.coordinate, is_revolute, ratio, body.offset, placement))
    return BodyChain(len(arm.coordinates), _row(arm.gravity), *zip(*rows, strict=True))


def _row(values: tuple[object, object, object]) -> Row:
    return tuple(map(float, values))  # type: ignore[arg-type]
