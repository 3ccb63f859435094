"""Plausibility checks of measured samples, and bounds of the unknown friction state."""

from collections.abc import Sequence
from typing import Literal, get_args

import numpy as np

from spelgen.dynamics.bristles import BristleReach
from spelgen.live.momentum import Balance, balance
from spelgen.live.noise import NoiseLevels
from spelgen.live.tuning import TUNING
from spelgen.runtime.rigid_body_dynamics import RigidBodyDynamics, RigidParameters

Refusal = Literal["used", "not finite", "repeated", "reversed", "jump", "saturated", "gap"]
REFUSALS: tuple[Refusal, ...] = get_args(Refusal)
IGNORED: tuple[Refusal, ...] = ("not finite", "repeated", "reversed", "jump")
"""Reasons for which nothing of a sample is used."""


class DelayLine:
    """Delay of signals by a constant time, with linear interpolation between samples."""

    def __init__(self, delay: float) -> None:
        self.delay = delay
        self.samples: list[tuple[float, np.ndarray]] = []

    def step(self, t: float, values: np.ndarray) -> np.ndarray:
        """Add values at time t [s]; return the values ``delay`` seconds before, or the oldest ones."""
        samples, at = self.samples, t - self.delay
        if not samples or t - samples[-1][0] >= self.delay / TUNING.delay_samples:
            samples.append((t, values))
        while len(samples) > 2 and samples[1][0] <= at:
            del samples[0]
        (begin, first), (end, second) = samples[0], samples[-1 if len(samples) == 1 else 1]
        if at <= begin:
            return first
        weight = (at - begin) / (end - begin)
        return (1 - weight) * first + weight * second


class Intake:
    """Checks of samples one after the other, and bounds of the friction state.

    counts: number of samples for each result of the check. low, high: bounds of the friction state, (n, K) [rad, m].
    The initial bounds are minus and plus the break-away displacements. Motion of a joint makes both bounds equal: the
    friction state of the joint is then known. aligned: q, qd and tau of the last used sample at one time: the motion
    is delayed like the torques, or the torques if these are ahead, (3, n).
    """

    def __init__(self, levels: NoiseLevels, bristles: BristleReach) -> None:
        self.levels, self.bristles = levels, bristles
        self.limit = bristles.values
        self.counts = dict.fromkeys(REFUSALS, 0)
        self.t, self.ignored = -np.inf, 0
        self.q = self.path = np.zeros(len(self.limit))
        self._begin()

    def _begin(self) -> None:
        """Reset the friction state and the delay: the motion so far is unknown."""
        self.low, self.high = -self.limit, self.limit
        self.line = DelayLine(abs(self.levels.delay))

    def accept(self, t: float, q: np.ndarray, qd: np.ndarray, tau: np.ndarray) -> Refusal:
        """Check a sample and update the bounds of the friction state; return "used" or the reason of a refusal."""
        refusal = self._check(t, q, qd, tau)
        # Several refused samples in a row show that the clock or the positions have changed permanently: restart.
        self.ignored += refusal in ("reversed", "jump")
        restarts = self.ignored >= TUNING.restart
        refusal = "gap" if restarts else refusal
        if refusal not in IGNORED:
            begins = refusal == "gap" or self.t == -np.inf
            if begins:
                self._begin()
            now = np.stack([q, qd, tau])
            is_delayed = np.array([[True], [True], [False]]) == (self.levels.delay > 0)
            self.aligned = np.where(is_delayed, self.line.step(t, now), now)
            # Position changes of one encoder step are treated as rounding, not as motion.
            position = self.aligned[0]
            start = position if begins else self.path
            path = np.clip(start, position - self.levels.encoder, position + self.levels.encoder)
            moved = path - start
            if self.bristles.motors is not None:
                moved = self.bristles.motors @ moved
            self.low = np.clip(self.low + moved[:, None], -self.limit, self.limit)
            self.high = np.clip(self.high + moved[:, None], -self.limit, self.limit)
            self.path, self.t, self.q, self.ignored = path, t, q, 0
        self.counts[refusal] += 1
        return refusal

    def _check(self, t: float, q: np.ndarray, qd: np.ndarray, tau: np.ndarray) -> Refusal:
        if not np.isfinite([t, *q, *qd, *tau]).all():
            return "not finite"
        if t <= self.t:
            return "repeated" if t == self.t else "reversed"
        speed = TUNING.jump * self.levels.speed
        if (np.abs(qd) > speed).any():
            return "jump"
        if t - self.t > TUNING.gap:
            return "used" if self.t == -np.inf else "gap"
        # The limit includes one encoder step, and motion for `TUNING.block` seconds, since time stamps may be delayed.
        furthest = speed * (t - self.t + TUNING.block / TUNING.jump) + self.levels.encoder
        if (np.abs(q - self.q) > furthest).any():
            return "jump"
        return "saturated" if (np.abs(tau) >= self.levels.effort).any() else "used"


def balance_along(
    model: RigidBodyDynamics,
    levels: NoiseLevels,
    intake: Intake,
    t: np.ndarray,
    samples: Sequence[np.ndarray],
    prepared: RigidParameters | None = None,
) -> tuple[list[Refusal], list[Balance | None]]:
    """Check samples; return the result of each check, and the terms of the momentum balance at each sample.

    The terms of ignored samples are None.

    Args:
        model: model in double precision.
        levels: noise levels, which include the point whose Jacobian is among the terms.
        intake: checks of the samples; its state is updated.
        t: times, (T,) [s].
        samples: q, qd and tau, (T, n).
        prepared: parameter cache of the model; None: the function computes it.
    """
    refusals: list[Refusal] = []
    states: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    for sample in zip(t.tolist(), *samples, strict=True):
        refusals.append(intake.accept(*sample))
        if refusals[-1] not in IGNORED:
            states.append((intake.aligned, intake.low, intake.high))
    used = [k for k, refusal in enumerate(refusals) if refusal not in IGNORED]
    terms: list[Balance | None] = [None] * len(t)
    if used:
        # All samples are computed in one call, since a call of torch takes longer than the arithmetic of one sample.
        aligned, low, high = map(np.array, zip(*states, strict=True))
        columns = balance(model, levels.point, [*aligned.swapaxes(0, 1)], (low, high), prepared)
        for k, *row in zip(used, *columns, strict=True):
            terms[k] = Balance(*row)
    return refusals, terms
