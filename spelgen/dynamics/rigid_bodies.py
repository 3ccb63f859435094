"""The bodies of an arm as the runtime's own chain."""

from __future__ import annotations

from typing import Any

from spelgen.arm.arm import Arm
from spelgen.runtime.body_chain import BodyChain
from spelgen.runtime.parts import Row
from spelgen.runtime.rigid_body import Bodies


def body_chain(arm: Arm) -> BodyChain:
    """Return how the arm's bodies may move, for q (..., n) [rad; m]."""
    rows: list[tuple[Any, ...]] = []
    for body in arm.bodies:
        geometry = tuple(map(_row, body.rotation)), _row(body.translation)
        is_revolute, ratio = body.kind == "revolute", float(body.multiplier)
        # a chain is geometry: inertia stays empty
        rows.append((body.parent, body.coordinate, is_revolute, ratio, body.offset, *geometry, ()))
    bodies = Bodies(*zip(*rows, strict=True))
    return BodyChain(len(arm.coordinates), bodies, _row(arm.gravity))


def _row(values: tuple[object, object, object]) -> Row:
    x, y, z = map(float, values)  # type: ignore[arg-type]
    return x, y, z
