"""What logs show of drives that nobody told: torques logged too late, and motors that move several joints.

Both are asked of least squares with friction without memory, on samples of all logs, thinned: would the torques be
explained better, in blocks of time that the parameters were not fitted to?
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
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


def torque_delay(problem: DriveProblem) -> tuple[float, float] | None:
    """How much later torques are logged than they act [s], and what is left of the squared error if that is mended;
    None: nothing that is sure.
    """
    samples = problem.samples
    total = [problem.errors(tau).mean() for tau in samples.tau]
    best, now = int(np.argmin(total)), int(np.abs(DELAYS).argmin())
    if not 0 < best < len(DELAYS) - 1:
        return None
    before, at, after = total[best - 1 : best + 2]  # a parabola through them
    delay = DELAYS[best] + 0.5 * (before - after) / (before - 2 * at + after) * (DELAYS[1] - DELAYS[0])
    earlier = int(np.searchsorted(DELAYS, delay)) - 1  # torques are smooth from one of DELAYS to the next
    part = (delay - DELAYS[earlier]) / (DELAYS[1] - DELAYS[0])
    moved = (1 - part) * samples.tau[earlier] + part * samples.tau[earlier + 1]
    logged, mended = (problem.errors(tau).mean(axis=1) for tau in (samples.tau[now], moved))
    if not _sure(logged, mended, CLEAR):
        return None
    return float(delay), float(mended.mean() / logged.mean())


def coupling(problem: DriveProblem) -> Coupling | None:
    """The coupling between two joints' motors that explains torques best; None: none is sure.

    Joints that known couplings join are left alone.
    """
    tau = problem.samples.tau[np.abs(DELAYS).argmin()]
    plain = problem.errors(tau)
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
    """The torques of two joints, one of whose motors may turn with the other one, too.

    Only these two torques' rows, and of them the columns of that motor, change with the ratio.
    """

    def __init__(
        self, problem: DriveProblem, tau: np.ndarray, joint: int, moved_by: int, logged_at: LoggedAt
    ) -> None:
        self.problem, self.logged_at, self.both = problem, logged_at, [joint, moved_by]
        self.tau = (tau / problem.scale(tau))[:, self.both]
        self.inverse_scale = 1 / problem.scale(tau)[self.both]
        others = [k for k in range(tau.shape[1]) if k not in self.both]
        self.others = problem.normal(tau, others)
        self.tried: dict[float, np.ndarray] = {}

    def errors(self, ratio: float) -> np.ndarray:
        """Mean of both joints by block that was not fitted, (B,)."""
        if ratio not in self.tried:
            rows = self.inverse_scale[:, None] * self.rows(ratio)  # (S, 2, K)
            own = [x + y for x, y in zip(self.others, self.problem.sums(rows, self.tau), strict=True)]
            missed = self.problem.missed(rows, self.tau, *own)
            self.tried[ratio] = missed.mean(axis=1)
        return self.tried[ratio]

    def rows(self, ratio: float) -> np.ndarray:
        """Of both torques where the motor turns by ``ratio`` with the other joint, too, (S, 2, K)."""
        joint, moved_by = self.both
        qd, qdd = (x[:, joint] + ratio * x[:, moved_by] for x in self.problem.samples[1:3])
        motor = self.problem.of_motor(joint)
        rows = self.problem.rows[:, self.both]
        rows[:, 0, motor] = SLOW.columns(qd[:, None], qdd[:, None])[:, 0, self.problem.effects(motor)]
        rows[:, 1, motor] = ratio * rows[:, 0, motor]
        if self.logged_at == "motors":
            rows[:, 1] -= ratio * rows[:, 0]
        return rows

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


class DriveProblem:
    """Least squares of these samples; rows (S, n, K) of the regressor, of the parameters that the torques show.

    speeds: C, (n, n), of the motors, by the couplings that are known.
    """

    def __init__(self, arm: Arm, samples: DriveSamples, speeds: np.ndarray) -> None:
        self.samples, self.speeds = samples, speeds
        bodies = regressor(arm, samples.q, samples.qd, samples.qdd)
        friction = SLOW.columns(samples.qd, samples.qdd, None, speeds)
        columns = base_parameters(arm, SLOW, speeds).columns
        self.rows: np.ndarray = np.concatenate([bodies, friction], axis=2)[..., columns]
        self._of_drives = columns - bodies.shape[2]  # effect e of drive j is n e + j; below zero: of bodies
        edges = [-(-k * len(samples.q) // BLOCKS) for k in range(BLOCKS + 1)]
        self.blocks = [slice(*each) for each in pairwise(edges)]
        self._squares = np.stack([self.sums(x[:, None])[0] for x in self.rows.swapaxes(0, 1)])  # (n, B, K, K)

    def scale(self, tau: np.ndarray) -> np.ndarray:
        """The unit of each torque (S, n), (n,)."""
        return np.where(_varies(tau), tau.std(axis=0), 1.0)

    def of_motor(self, joint: int) -> np.ndarray:
        """Whether a parameter is this motor's, (K,)."""
        mine: np.ndarray = (self._of_drives >= 0) & (self._of_drives % len(self.speeds) == joint)
        return mine

    def effects(self, which: np.ndarray) -> np.ndarray:
        """The effects of these parameters of drives."""
        found: np.ndarray = self._of_drives[which] // len(self.speeds)
        return found

    def sums(self, rows: np.ndarray, tau: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """By block, of rows (S, J, K) and torques (S, J): their squares (B, K, K), and both together (B, K)."""
        flat = [rows[block].reshape(-1, rows.shape[2]) for block in self.blocks]
        squares = np.stack([x.T @ x for x in flat])
        if tau is None:
            return squares, squares[..., 0]
        together = [x.T @ tau[block].ravel() for x, block in zip(flat, self.blocks, strict=True)]
        return squares, np.stack(together)

    def normal(self, tau: np.ndarray, joints: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
        """As `sums`, of the torques (S, n) of some joints, in their units."""
        weights = self.scale(tau)[joints] ** -2
        squares = np.tensordot(weights, self._squares[joints], axes=1)
        together = [
            np.einsum("sjk,sj->k", self.rows[b][:, joints], tau[b][:, joints] * weights) for b in self.blocks
        ]
        return squares, np.stack(together)

    def errors(self, tau: np.ndarray) -> np.ndarray:
        """Squared errors by block that was not fitted, (B, n), by each torque's variance."""
        scale, everyone = self.scale(tau), range(tau.shape[1])
        return self.missed(self.rows / scale[:, None], tau / scale, *self.normal(tau, everyone))

    def missed(
        self, rows: np.ndarray, tau: np.ndarray, squares: np.ndarray, together: np.ndarray
    ) -> np.ndarray:
        """Mean squares (B, J) of what rows (S, J, K) leave of torques (S, J), in each block with the parameters of all
        others, by their `sums`.
        """
        size = np.sqrt(squares.sum(axis=0).diagonal())
        size = np.where(size > 0, size, 1.0)
        squares, together = squares / np.outer(size, size), together / size
        left_out = squares.sum(axis=0) - squares + NEGLIGIBLE * np.eye(len(size))
        found = np.linalg.solve(left_out, (together.sum(axis=0) - together)[..., None])[..., 0] / size
        parts = zip(self.blocks, found, strict=True)
        return np.stack([np.square(rows[block] @ x - tau[block]).mean(axis=0) for block, x in parts])

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


def coupled_inputs(drives: Drives, found: Coupling) -> np.ndarray:
    """Joint torques by motor torques (n, n) with the coupling that was found."""
    through = np.eye(len(drives.inputs))
    through[found.moved_by, found.joint] = found.ratio
    inputs: np.ndarray = through @ drives.inputs
    return inputs
