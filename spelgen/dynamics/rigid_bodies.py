"""The bodies of an arm by the runtime's own chain: their dynamics for any inertial parameters."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from spelgen.arm.arm import Arm
from spelgen.runtime.body_chain import BodyChain
from spelgen.runtime.parts import Row
from spelgen.runtime.rigid_body import Bodies, spatial_inertia

PER_BODY = 10  # inertial parameters


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


class RigidBodies:
    """The bodies of an arm with these inertial parameters, (10 B,), possible or not, in the order of ``regressor``."""

    def __init__(self, arm: Arm, parameters: np.ndarray) -> None:
        self.chain = body_chain(arm)
        ten = torch.from_numpy(np.asarray(parameters, dtype=float)).reshape(-1, PER_BODY)
        self.inertia = torch.block_diag(*spatial_inertia(ten))

    def at(self, q: torch.Tensor) -> tuple[torch.Tensor, Callable[[torch.Tensor], torch.Tensor]]:
        """Return M, (T, n, n), at q, (T, n), and the function that gives Coriolis, centrifugal and gravity torques,
        (T, n) [Nm, N], there of qd, (T, n).
        """
        chain = self.chain.forward(q)
        momenta = chain.twists @ self.inertia
        return momenta @ chain.twists.mT, lambda qd: self.chain.steady_torque(chain, qd, momenta)


def _row(values: tuple[object, object, object]) -> Row:
    x, y, z = map(float, values)  # type: ignore[arg-type]
    return x, y, z
