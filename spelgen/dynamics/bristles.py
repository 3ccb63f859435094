"""The memory of friction along a measured path: the state z of `runtime.bristles` at every sample, in one pass."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from spelgen.design import BRISTLE_REACH
from spelgen.dynamics.protocol import has_friction_state


@dataclass(frozen=True, eq=False)
class BristleReach:
    """How far the bristles of an arm's drives reach: values, (n, K) [rad, m]; K is 0 where there are none.

    motors: C, (n, n), the drives turn by C times what the joints do (see ``Actuation.motor_speeds``); None: each moves
    its own joint alone. smoothing_velocity: (n,) [rad/s, m/s], over which dry friction without memory turns around.
    """

    values: np.ndarray
    motors: np.ndarray | None = None
    smoothing_velocity: np.ndarray | None = None

    @property
    def elements(self) -> int:
        """K."""
        return int(self.values.shape[1])


NO_BRISTLES = BristleReach(np.zeros((0, 0)))
BLOCK = (
    2**14
)  # samples in one pass, whose number of operations grows with its length times the logarithm of it


def reach_of(kinds: Sequence[str], motors: np.ndarray | None = None) -> BristleReach:
    """Of joints of these kinds."""
    return BristleReach(np.array([BRISTLE_REACH[kind] for kind in kinds]), motors)


def bristle_reach(model: Any) -> BristleReach:
    """Of a model."""
    if not has_friction_state(model):
        return BristleReach(np.zeros((model.n, 0)))
    smoothing = model.friction.prepare().coulomb_smoothing_velocity.detach()
    arrays = [x.cpu().double().numpy() for x in (model.friction.bristles.reach, model.motors, smoothing)]
    return BristleReach(*arrays)


def bristles_along(q: np.ndarray, bristles: BristleReach) -> np.ndarray:
    """z, (T, n, K) [rad, m], along the path q (T, n), straight at its start.

    Between samples drives go one way, which is exact: z' is linear in the displacement.
    """
    moved = np.diff(encoded(q), axis=0, prepend=q[:1])
    if bristles.motors is not None:
        moved = moved @ bristles.motors.T
    z = np.empty((*q.shape, bristles.values.shape[-1]))
    state = np.zeros(z.shape[1:])
    for start in range(0, len(q), BLOCK):
        block = z[start : start + BLOCK]
        block[:] = _bent_along(moved[start : start + BLOCK, :, None], bristles.values, state)
        state = block[-1]
    return z


def _bent_along(way: np.ndarray, reach: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Return z, (T, n, K), along displacements (T, n, 1) from z = start (n, K)."""
    decay = np.exp(-np.abs(way) / reach)
    bent: np.ndarray = np.sign(way) * reach * (1 - decay)
    # z[k] = decay[k] z[k - 1] + bent[k]: pairs are joined, then fours, ...
    shift = 1
    while shift < len(way):
        bent[shift:] += decay[shift:] * bent[:-shift]
        decay[shift:] *= decay[:-shift].copy()
        shift *= 2
    return bent + decay * start


def direction_along(qd: np.ndarray, bristles: BristleReach) -> np.ndarray | None:
    """Return the direction (T, n) of dry friction without memory at these velocities; None: its width is not known."""
    if bristles.smoothing_velocity is None:
        return None
    speed = qd if bristles.motors is None else qd @ bristles.motors.T
    direction: np.ndarray = np.tanh(speed / bristles.smoothing_velocity)
    return direction


def encoded(q: np.ndarray) -> np.ndarray:
    """The path (T, n) without the jitter of encoders: it follows q out of a band of a step to both sides."""
    step = encoder_step(q)
    if not step.any():
        return q
    low, high = q - step, q + step  # clamping to a band after a band is clamping to one
    shift = 1
    while shift < len(q):
        earlier, later = slice(None, -shift), slice(shift, None)
        clamped = [np.clip(x[earlier], low[later], high[later]) for x in (low, high)]
        low[later], high[later] = clamped
        shift *= 2
    result: np.ndarray = np.clip(np.broadcast_to(q[:1], q.shape), low, high)
    return result


def encoder_step(q: np.ndarray) -> np.ndarray:
    """The step (n,) in which positions (T, n) come; 0 where they come in none."""
    steps = np.zeros(q.shape[1])
    for joint, values in enumerate(q.T):
        levels = np.unique(values)
        if len(levels) > 1 and len(levels) < len(values) / 4:  # values that come again and again
            steps[joint] = np.diff(levels).min()
    return steps
