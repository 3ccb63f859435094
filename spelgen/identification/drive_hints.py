"""What logs show of drives that nobody told: torques logged too late, and motors that move several joints.

Both are asked of least squares with friction without memory, on samples of all logs, thinned: would the torques be
explained better, in blocks of time that the parameters were not fitted to?
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from itertools import pairwise
from typing import Literal, get_args

import numpy as np

from spelgen.arm.actuation import Drives
from spelgen.arm.arm import Arm
from spelgen.dynamics.regressor import regressor
from spelgen.identification.base_parameters import base_parameters
from spelgen.identification.drive_samples import DELAYS, DriveSamples
from spelgen.identification.friction import FrictionModel

BLOCKS = 10
RATIOS = tuple(x * sign for sign in (1.0, -1.0) for x in (0.25, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0))
STEPS = (0.2, 0.1, 0.05, 0.02, 0.01)  # of the search that follows
SCREENED = (1.0, -1.0, 0.4, -0.4, 2.5, -2.5)
PAIRS = 4  # that are looked at closely
CLEAR, COUPLED = 0.8, 0.5  # of the squared error, what is left at most where it is worth telling
SURE = 2.82  # standard errors over blocks, as of what enters a fit
SIMPLE = 0.02  # of the squared error, what a ratio of small numbers may cost
SLOW = FrictionModel(coulomb_smoothing_velocity=0.02)
NEGLIGIBLE = 1e-10

LoggedAt = Literal["joints", "motors"]


@dataclass(frozen=True)
class Coupling:
    """The motor of `joint` turns `ratio` times as fast with `moved_by` beside its own joint.

    logged_at: whether the logged torques are those of the joints, or of the motors (in the joints' units). left: of the
    squared error of the two joints' torques, what the coupling leaves.
    """

    joint: int
    moved_by: int
    ratio: float
    logged_at: LoggedAt
    left: float


def torque_delay(arm: Arm, samples: DriveSamples, speeds: np.ndarray) -> tuple[float, float] | None:
    """How much later torques are logged than they act [s], and what is left of the squared error if that is mended;
    None: nothing that is sure. speeds: C, (n, n), of the motors.
    """
    problem = _Problem(arm, samples, speeds)
    total = [problem.errors(problem.rows, tau).mean() for tau in samples.tau]
    best, now = int(np.argmin(total)), int(np.abs(DELAYS).argmin())
    if not 0 < best < len(DELAYS) - 1:
        return None
    before, at, after = total[best - 1 : best + 2]  # a parabola through them
    delay = DELAYS[best] + 0.5 * (before - after) / (before - 2 * at + after) * (DELAYS[1] - DELAYS[0])
    earlier = int(np.searchsorted(DELAYS, delay)) - 1  # torques are smooth from one of DELAYS to the next
    part = (delay - DELAYS[earlier]) / (DELAYS[1] - DELAYS[0])
    moved = (1 - part) * samples.tau[earlier] + part * samples.tau[earlier + 1]
    logged, mended = (problem.errors(problem.rows, tau).mean(axis=1) for tau in (samples.tau[now], moved))
    if not _sure(logged, mended, CLEAR):
        return None
    return float(delay), float(mended.mean() / logged.mean())


def coupling(arm: Arm, samples: DriveSamples, speeds: np.ndarray) -> Coupling | None:
    """The coupling between two joints' motors that explains torques best; None: none is sure.

    speeds: C, (n, n), of the couplings that are known; joints that these join are left alone.
    """
    problem = _Problem(arm, samples, speeds)
    tau = samples.tau[np.abs(DELAYS).argmin()]
    plain = problem.errors(problem.rows, tau)
    found = []
    for joint, moved_by in problem.suspects(tau):
        before = plain[:, [joint, moved_by]].mean(axis=1)
        for logged_at in get_args(LoggedAt):
            pair = _Pair(problem, tau, joint, moved_by, logged_at)
            ratio = pair.best_ratio()
            after = pair.errors(ratio)
            if _sure(before, after, COUPLED):
                left = float(after.mean() / before.mean())
                found.append(Coupling(joint, moved_by, round(ratio, 3), logged_at, left))
    return min(found, key=lambda x: x.left, default=None)


class _Pair:
    """The torques of two joints, one of whose motors may turn with the other one, too."""

    def __init__(
        self, problem: _Problem, tau: np.ndarray, joint: int, moved_by: int, logged_at: LoggedAt
    ) -> None:
        self.problem, self.tau, self.logged_at = problem, tau, logged_at
        self.joint, self.moved_by = joint, moved_by
        self.tried: dict[float, np.ndarray] = {}

    def errors(self, ratio: float) -> np.ndarray:
        """Mean of both joints by block that was not fitted, (B,)."""
        if ratio not in self.tried:
            rows = self.problem.coupled(self.joint, self.moved_by, ratio, self.logged_at)
            both = self.problem.errors(rows, self.tau)[:, [self.joint, self.moved_by]]
            self.tried[ratio] = both.mean(axis=1)
        return self.tried[ratio]

    def best_ratio(self) -> float:
        """The ratio with the least error, one of small numbers where that costs little."""
        error = lambda ratio: float(self.errors(ratio).mean())  # noqa: E731
        best = min(RATIOS, key=error)
        for step in STEPS:
            best = min((best, best * (1 - step), best * (1 + step)), key=error)
        simple = float(Fraction(best).limit_denominator(4))
        return simple if simple and error(simple) <= (1 + SIMPLE) * error(best) else best


def _sure(before: np.ndarray, after: np.ndarray, most: float) -> bool:
    """Whether errors by block (B,) fell below this part, and not by luck."""
    if not after.min() > 0 or after.mean() >= most * before.mean():
        return False
    gain = np.log(before / after)  # by factors: a block that is hard to tell counts as any other
    return bool(gain.mean() > SURE * gain.std(ddof=1) / np.sqrt(len(gain)))


def _projected(values: np.ndarray, columns: np.ndarray) -> float:
    """The sum of squares of the values (S,) that a combination of the columns (S, C) explains."""
    left = values - columns @ np.linalg.lstsq(columns, values, rcond=NEGLIGIBLE)[0]
    return float(values @ values - left @ left)


def _varies(tau: np.ndarray) -> np.ndarray:
    """Whether torques (S, n) are more than a constant with rounding."""
    found: np.ndarray = tau.std(axis=0) > NEGLIGIBLE * np.abs(tau).max(axis=0)
    return found


class _Problem:
    """Least squares of these samples; rows (S, n, K) of the regressor, of the parameters that the torques show."""

    def __init__(self, arm: Arm, samples: DriveSamples, speeds: np.ndarray) -> None:
        self.arm, self.samples, self.speeds = arm, samples, speeds
        self.bodies = regressor(arm, samples.q, samples.qd, samples.qdd)
        base = base_parameters(arm, SLOW, speeds)
        self.columns = base.columns
        self.rows = self._rows(speeds)
        edges = [-(-k * len(samples.q) // BLOCKS) for k in range(BLOCKS + 1)]
        self.blocks = [slice(*each) for each in pairwise(edges)]

    def _rows(self, speeds: np.ndarray) -> np.ndarray:
        friction = SLOW.columns(self.samples.qd, self.samples.qdd, None, speeds)
        rows: np.ndarray = np.concatenate([self.bodies, friction], axis=2)[..., self.columns]
        return rows

    def errors(self, rows: np.ndarray, tau: np.ndarray) -> np.ndarray:
        """Squared errors by block that was not fitted, (B, n), by each torque's variance."""
        scale = np.where(_varies(tau), tau.std(axis=0), 1.0)
        a = rows / scale[:, None]
        b = tau / scale
        size = np.sqrt(np.square(a).sum(axis=(0, 1)))
        a /= np.where(size > 0, size, 1.0)
        parts = [(a[block], b[block]) for block in self.blocks]
        flat = [(x.reshape(-1, x.shape[2]), y.reshape(-1)) for x, y in parts]
        normal = [(x.T @ x, x.T @ y) for x, y in flat]
        whole, right = (sum(each) for each in zip(*normal, strict=True))
        found = []
        for (x, y), (own, own_right) in zip(parts, normal, strict=True):
            left_out = whole - own + NEGLIGIBLE * np.eye(len(whole))
            found.append(np.square(x @ np.linalg.solve(left_out, right - own_right) - y).mean(axis=0))
        return np.stack(found)

    def suspects(self, tau: np.ndarray) -> Iterator[tuple[int, int]]:
        """The pairs (joint, moved by) for whose coupling most speaks at first sight."""
        n = tau.shape[1]
        flat = self.rows.reshape(-1, self.rows.shape[2])
        solution = np.linalg.lstsq(flat, tau.reshape(-1), rcond=NEGLIGIBLE)[0]
        missed = tau - self.rows @ solution
        known = (self.speeds != 0) | (self.speeds != 0).T
        free = (known.sum(axis=0) == 1) & _varies(tau)
        missed = missed / np.where(_varies(tau), tau.std(axis=0), 1.0)
        gains = {
            (joint, by): max(self._explained(missed, tau, joint, by, ratio) for ratio in SCREENED)
            for joint in range(n)
            for by in range(n)
            if joint != by and free[joint] and free[by]
        }
        yield from sorted(gains, key=lambda pair: -gains[pair])[:PAIRS]

    def _explained(self, missed: np.ndarray, tau: np.ndarray, joint: int, by: int, ratio: float) -> float:
        """Of what is missed (S, n) of two torques, the squares that come by friction and rotor of one motor, where
        this turns with the other joint too, and by its torque.
        """
        qd, qdd = self.samples.qd, self.samples.qdd
        dry = np.tanh((qd[:, joint] + ratio * qd[:, by]) / SLOW.coulomb_smoothing_velocity)
        return sum(
            _projected(missed[:, at], np.stack([*beside, qd[:, other], qdd[:, other], dry], axis=1))
            for at, other, beside in ((by, joint, [tau[:, joint]]), (joint, by, []))
        )

    def coupled(self, joint: int, moved_by: int, ratio: float, logged_at: LoggedAt) -> np.ndarray:
        """The rows where the motor of a joint turns by `ratio` with another one, too."""
        speeds = self.speeds.copy()
        speeds[joint] = speeds[joint] + ratio * speeds[moved_by]
        rows = self._rows(speeds)
        if logged_at == "motors":
            rows[:, moved_by] -= ratio * rows[:, joint]
        return rows


def coupled_inputs(drives: Drives, found: Coupling) -> np.ndarray:
    """Joint torques by motor torques (n, n) with the coupling that was found."""
    through = np.eye(len(drives.inputs))
    through[found.moved_by, found.joint] = found.ratio
    inputs: np.ndarray = through @ drives.inputs
    return inputs
