"""Plausibility checks of measured samples for the estimator, and bounds of the unknown friction state."""

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
"""Reasons of refusals for which nothing of a sample is used; with other reasons, a sample is partly used."""


class DelayLine:
    """Delay of measured signals by a constant time, with linear interpolation between samples.

    It synchronizes positions and torques if one of the two is measured later. delay: time [s].
    """

    def __init__(self, delay: float) -> None:
        self.delay = delay
        self.samples: list[tuple[float, np.ndarray]] = []

    def step(self, t: float, values: np.ndarray) -> np.ndarray:
        """Add values (q, qd, tau), (3, n), at time t [s]; return them at t - ``delay``, or the oldest stored values."""
        samples, past = self.samples, t - self.delay
        if not samples or t - samples[-1][0] >= self.delay / TUNING.delay_samples:
            samples.append((t, values))
        while len(samples) > 2 and samples[1][0] <= past:
            del samples[0]
        (begin, first), (end, second) = samples[0], samples[:2][-1]
        if past <= begin:
            return first
        weight = (past - begin) / (end - begin)
        return (1 - weight) * first + weight * second


class Intake:
    """Checks of consecutive samples, and bounds of the friction state (deflections of bristles).

    The initial bounds of a deflection are minus and plus the break-away displacement. After a sufficient motion of a
    joint both bounds are equal, and its friction state is known.

    Args:
        levels: limits by which samples are refused, and the delay of torques.
        bristles: break-away displacements of the K bristles of each drive.

    Attributes:
        counts: number of samples for each result of the check, such as {"used": 120, "jump": 1}.
        bounds: Lower and upper bound of the friction state of each of K bristles, (2, n, K) [rad, m].
        aligned: q, qd and tau of the last used sample, (3, n), at the same time: q and qd are delayed if measured
            torques lag behind the motion, tau is delayed if they precede it.
    """

    def __init__(self, levels: NoiseLevels, bristles: BristleReach) -> None:
        self.levels, self.bristles = levels, bristles
        self.limit = bristles.values
        self.counts = dict.fromkeys(REFUSALS, 0)
        self.t, self.ignored = -np.inf, 0
        self.q = self.path = np.zeros(len(self.limit))
        self._begin()

    def _begin(self) -> None:
        """Discard the past motion: reset the bounds of the bristle deflections and the delay line of q, qd and tau."""
        self.bounds = np.stack([-self.limit, self.limit])
        self.line = DelayLine(abs(self.levels.delay))

    def accept(self, t: float, q: np.ndarray, qd: np.ndarray, tau: np.ndarray) -> Refusal:
        """Check a sample and update the bounds of the friction state, which is unknown at first (see the class).

        Args:
            t: time [s].
            q: positions, (n,) [rad, m].
            qd: velocities, (n,) [rad/s, m/s].
            tau: measured torques, (n,) [Nm, N].

        Returns:
            "used" if the sample is used; otherwise the reason of its refusal. Nothing of the sample is used if the
            reason is in `IGNORED`; otherwise a part of the sample is used.
        """
        refusal = self._check(t, q, qd, tau)
        # After `TUNING.restart` consecutive samples that are refused as "reversed" or "jump", a permanent change of the
        # clock or of the positions is assumed, and the checks restart with the current sample.
        self.ignored += refusal in ("reversed", "jump")
        if self.ignored >= TUNING.restart:
            refusal = "gap"
        if refusal not in IGNORED:
            begins = refusal == "gap" or self.t == -np.inf
            if begins:
                self._begin()
            now = np.stack([q, qd, tau])
            is_delayed = np.array([[True], [True], [False]]) == (self.levels.delay > 0)
            self.aligned = np.where(is_delayed, self.line.step(t, now), now)
            # The position has a dead band of one encoder step: `path` changes only if the position differs from it by
            # more. Smaller changes are rounding, and do not deflect the bristles.
            position = self.aligned[0]
            start = position if begins else self.path
            path = np.clip(start, position - self.levels.encoder, position + self.levels.encoder)
            moved = self.bristles.of_drives(path - start)
            self.bounds = np.clip(self.bounds + moved[:, None], -self.limit, self.limit)
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
        # The largest plausible motion since the last sample is c v dt + T v + e, with c = `TUNING.jump`, the largest
        # speed v of the training logs, the time step dt, T = `TUNING.block` and the encoder step e. The term T v is for
        # delayed time stamps, whose dt is too short. `speed` is c v.
        furthest = speed * (t - self.t + TUNING.block / TUNING.jump) + self.levels.encoder
        if (np.abs(q - self.q) > furthest).any():
            return "jump"
        return "saturated" if (np.abs(tau) >= self.levels.effort * self.levels.saturation).any() else "used"


def balance_along(
    model: RigidBodyDynamics,
    levels: NoiseLevels,
    intake: Intake,
    t: np.ndarray,
    samples: Sequence[np.ndarray],
    prepared: RigidParameters | None = None,
) -> tuple[list[Refusal], list[Balance | None]]:
    """Check T samples; return the result of each check, and the terms of the momentum balance at each sample.

    The terms of samples of which nothing is used (refused for a reason in `IGNORED`) are None.

    Args:
        model: model in double precision.
        levels: noise levels; they also have the position of the tip (`point`), whose Jacobian is one of the terms.
        intake: checks of the samples; its state is updated.
        t: times, (T,) [s].
        samples: q [rad, m], qd [rad/s, m/s] and tau [Nm, N], (T, n) each.
        prepared: parameter cache of the model; None: the function computes it.
    """
    refusals: list[Refusal] = []
    states = []
    for k, sample in enumerate(zip(t.tolist(), *samples, strict=True)):
        refusals.append(intake.accept(*sample))
        if refusals[-1] not in IGNORED:
            states.append((k, intake.aligned, intake.bounds))
    terms: list[Balance | None] = [None] * len(t)
    if states:
        # The terms of all samples are computed in one call, because the overhead of a call of torch is larger than the
        # computation for one sample.
        used, aligned, bounds = map(np.array, zip(*states, strict=True))
        signals, limits = [*aligned.swapaxes(0, 1)], [*bounds.swapaxes(0, 1)]
        columns = balance(model, levels.point, signals, limits, prepared)
        for k, *row in zip(used.tolist(), *columns, strict=True):
            terms[k] = Balance(*row)
    return refusals, terms
