"""Checks of each measured sample, and bounds of the friction state."""

from __future__ import annotations

from typing import Literal

import numpy as np

from spelgen.dynamics.bristles import BristleReach
from spelgen.live.noise import NoiseLevels
from spelgen.live.tuning import TUNING

Refusal = Literal["used", "not finite", "repeated", "reversed", "jump", "saturated", "gap"]
REFUSALS: tuple[Refusal, ...] = ("used", "not finite", "repeated", "reversed", "jump", "saturated", "gap")
IGNORED: tuple[Refusal, ...] = ("not finite", "repeated", "reversed", "jump")
"""Reasons for which nothing of a sample is used."""


class Intake:
    """The last accepted sample, counts of samples by reason, and bounds low and high of the friction state, (n, K)
    [rad, m].

    The bounds start at the break-away displacements. Motion of a joint makes them equal: its state is then known.
    """

    def __init__(self, levels: NoiseLevels, bristles: BristleReach) -> None:
        self.levels, self.bristles = levels, bristles
        self.limit = bristles.values
        self.counts = dict.fromkeys(REFUSALS, 0)
        self.restart()

    def restart(self) -> None:
        """Forget the last sample and the friction state."""
        self.t = -np.inf
        self.q = self.path = np.zeros(len(self.limit))
        self.ignored = 0
        self._unknown()

    def _unknown(self) -> None:
        self.low, self.high = -self.limit, self.limit.copy()

    def accept(self, t: float, q: np.ndarray, qd: np.ndarray, tau: np.ndarray) -> Refusal:
        """Check a sample, q, qd, tau (n,), update the bounds of the friction state, and return "used" or the reason."""
        refusal = self._check(t, q, qd, tau)
        # after several in a row, clock or positions have changed permanently
        self.ignored += refusal in ("reversed", "jump")
        restarts = self.ignored >= TUNING.restart
        if refusal == "gap" or restarts or self.t == -np.inf:
            self._unknown()
            self.path = q.copy()
        elif refusal not in IGNORED:
            step = self.levels.encoder
            path = np.clip(self.path, q - step, q + step)
            moved = (
                path - self.path
                if self.bristles.motors is None
                else self.bristles.motors @ (path - self.path)
            )
            self.low, self.high = (
                np.clip(z + moved[:, None], -self.limit, self.limit) for z in (self.low, self.high)
            )
            self.path = path
        if restarts or refusal not in IGNORED:
            refusal = "gap" if restarts else refusal
            self.t, self.q, self.ignored = t, q, 0
        self.counts[refusal] += 1
        return refusal

    def _check(self, t: float, q: np.ndarray, qd: np.ndarray, tau: np.ndarray) -> Refusal:
        if not (np.isfinite(t) and np.isfinite(q).all() and np.isfinite(qd).all() and np.isfinite(tau).all()):
            return "not finite"
        if t <= self.t:
            return "repeated" if t == self.t else "reversed"
        speed = TUNING.jump * self.levels.speed
        if (np.abs(qd) > speed).any():
            return "jump"
        if t - self.t > TUNING.gap:
            return "used" if self.t == -np.inf else "gap"
        # allowance for one encoder step, and for a sample with a delayed time stamp
        if (
            np.abs(q - self.q) > speed * (t - self.t + TUNING.block / TUNING.jump) + self.levels.encoder
        ).any():
            return "jump"
        return "saturated" if (np.abs(tau) >= self.levels.effort).any() else "used"
