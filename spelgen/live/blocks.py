"""The momentum balance, averaged over blocks of samples; there is no low-pass filter."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spelgen.live.momentum import Balance
from spelgen.live.tuning import TUNING


@dataclass(eq=False)
class Block:
    """Means of the terms of the momentum balance over a block of samples.

    duration [s]. y: torque residual of the model, (n,) [Nm, N]. load: regressor Phi of the payload, (n, 10).
    friction: of the model, (n,) [Nm, N]. uncertainty: of friction whose state is not known exactly, (n,) [Nm, N].
    moving: whether each joint moved, (n,).
    """

    duration: float
    y: np.ndarray
    load: np.ndarray
    friction: np.ndarray
    uncertainty: np.ndarray
    moving: np.ndarray


class Blocks:
    """Accumulator of samples that returns a `Block` after each period of `TUNING.block` seconds."""

    def __init__(self, n: int, rest_speed: np.ndarray) -> None:
        self.n, self.rest_speed = n, rest_speed
        self.last: tuple[float, Balance] | None = None
        self._start()

    def restart(self) -> None:
        """Discard the samples of the current block, after a gap."""
        self.last = None

    def _start(self) -> None:
        self.duration = 0.0
        self.torque, self.friction, self.uncertainty, self.fastest = np.zeros((4, self.n))
        self.load = np.zeros((self.n, 10))

    def add(self, t: float, qd: np.ndarray, at: Balance) -> Block | None:
        """Add a sample: time [s], velocities (n,) and terms of the balance; return the block if it is complete."""
        if self.last is None:
            self._start()
            self.last, self.first = (t, at), at
            return None
        then, before = self.last
        self.last = t, at
        step = t - then
        half = step / 2
        self.duration += step
        self.torque += half * (before.torque - before.friction + (at.torque - at.friction))
        self.friction += half * (before.friction + at.friction)
        self.uncertainty += half * (before.uncertainty + at.uncertainty)
        self.load += half * (before.load_torque + at.load_torque)
        self.fastest = np.maximum(self.fastest, np.abs(qd))
        if self.duration < TUNING.block - half:
            return None
        duration = self.duration
        block = Block(
            duration,
            (self.torque - (at.momentum - self.first.momentum)) / duration,
            (at.load_momentum - self.first.load_momentum - self.load) / duration,
            self.friction / duration,
            self.uncertainty / duration,
            self.fastest > self.rest_speed,
        )
        self._start()
        self.first = at
        return block


def joined(first: Block, second: Block) -> Block:
    """Return one block for two consecutive blocks."""
    duration = first.duration + second.duration
    weight = second.duration / duration

    def mean(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Return the mean of a and b (n, ...), weighted by duration."""
        average: np.ndarray = a + weight * (b - a)
        return average

    return Block(
        duration,
        mean(first.y, second.y),
        mean(first.load, second.load),
        mean(first.friction, second.friction),
        mean(first.uncertainty, second.uncertainty),
        first.moving & second.moving,
    )
