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


class Intake:
    """Checks of samples one after the other, and bounds of the friction state.

    The initial bounds of the friction state are minus and plus the break-away displacements. After a sufficient motion
    of a joint both bounds are equal, and its friction state is known.

    Attributes:
        counts: {result of the check: number of samples}.
        low: Lower bound of the friction state of each of K bristles, (n, K) [rad, m].
        high: Upper bound, (n, K) [rad, m].
    """

    def __init__(self, levels: NoiseLevels, bristles: BristleReach) -> None:
        self.levels, self.bristles = levels, bristles
        self.limit = bristles.values
        self.counts = dict.fromkeys(REFUSALS, 0)
        self.t, self.ignored = -np.inf, 0
        self.q = self.path = np.zeros(len(self.limit))
        self.low, self.high = -self.limit, self.limit

    def accept(self, t: float, q: np.ndarray, qd: np.ndarray, tau: np.ndarray) -> Refusal:
        """Check a sample and update the bounds of the friction state.

        Return "used", or the reason why the sample is refused or only partly used. t: time [s]. q, qd, tau: (n,) each.
        """
        refusal = self._check(t, q, qd, tau)
        # After `TUNING.restart` consecutive samples with such a refusal, a permanent change of the clock or of the
        # positions is assumed, and the checks restart with the current sample.
        self.ignored += refusal in ("reversed", "jump")
        restarts = self.ignored >= TUNING.restart
        if refusal == "gap" or restarts or self.t == -np.inf:
            self.low, self.high = -self.limit, self.limit
            self.path = q.copy()
        elif refusal not in IGNORED:
            # Position changes of one encoder step are treated as rounding, not as motion.
            path = np.clip(self.path, q - self.levels.encoder, q + self.levels.encoder)
            moved = path - self.path
            if self.bristles.motors is not None:
                moved = self.bristles.motors @ moved
            self.low = np.clip(self.low + moved[:, None], -self.limit, self.limit)
            self.high = np.clip(self.high + moved[:, None], -self.limit, self.limit)
            self.path = path
        if restarts or refusal not in IGNORED:
            refusal = "gap" if restarts else refusal
            self.t, self.q, self.ignored = t, q, 0
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
        # The largest possible motion since the last sample. Time stamps may be delayed, so the limit includes a motion
        # of `TUNING.block` seconds at the largest speed of the training logs, and one encoder step.
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
    bounds: list[tuple[np.ndarray, np.ndarray]] = []
    for sample in zip(t.tolist(), *samples, strict=True):
        refusals.append(intake.accept(*sample))
        bounds.append((intake.low, intake.high))
    used = [k for k, refusal in enumerate(refusals) if refusal not in IGNORED]
    terms: list[Balance | None] = [None] * len(t)
    if used:
        # The terms of all samples are computed in one call, because the overhead of a call of torch is larger than the
        # computation for one sample.
        low, high = np.array([bounds[k] for k in used]).swapaxes(0, 1)
        columns = balance(model, levels.point, [x[used] for x in samples], (low, high), prepared)
        for k, *row in zip(used, *columns, strict=True):
            terms[k] = Balance(*row)
    return refusals, terms
