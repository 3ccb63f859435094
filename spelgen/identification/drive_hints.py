"""Find what logs show of drives that no file says: motors that move several joints, and wrong torques.

Both are asked of least squares with friction without memory, on samples of all logs, thinned. The products of its
columns are formed once; a candidate has other columns of one or two joints. The best candidate counts if it explains
the torques better in blocks of time that the parameters were not fitted to.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property
from itertools import combinations_with_replacement, permutations
from typing import Literal

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.special import stdtrit

from spelgen.arm.actuation import Drives
from spelgen.dynamics.body_regressor import chain_regressor
from spelgen.dynamics.linear_friction import FrictionModel
from spelgen.identification.drive_samples import DriveSamples
from spelgen.identification.least_squares import block_products, normal_solution
from spelgen.identification.tuning import HINTS, TUNING
from spelgen.logs.tuning import SAMPLES
from spelgen.runtime.body_chain import BodyChain

FRICTION = FrictionModel(coulomb_smoothing_velocity=SAMPLES.moving)


@dataclass(frozen=True)
class Coupling:
    """The motor of `joint` turns `ratio` times as fast with `moved_by` beside its own joint.

    logged_at: whether the logged torques are those of the joints, or of the motors (in the joints' units).
    """

    joint: int
    moved_by: int
    ratio: float
    logged_at: Literal["joints", "motors"]

    @property
    def pair(self) -> list[int]:
        """Return both joints."""
        return [self.joint, self.moved_by]


@dataclass(frozen=True)
class WrongTorque:
    """Say why the torques of a joint cannot be right: `code` of what may be accepted, `got` in an error."""

    joint: int
    code: str
    got: str


def drive_rows(
    chain: BodyChain, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray, speeds: np.ndarray
) -> np.ndarray:
    """Return the regressor (S, n, K) of bodies, then of friction's effects, of all drives each.

    q, qd, qdd: (S, n). speeds: C, (n, n), of the motors, by the couplings that are known.
    """
    bodies = chain_regressor(chain, q, qd, qdd)
    return np.concatenate([bodies, FRICTION.columns(qd, qdd, None, speeds)], axis=2)


def drive_problem(chain: BodyChain, drives: Drives, samples: DriveSamples) -> DriveProblem:
    """Return least squares of the joint torques."""
    regressors = drive_rows(chain, samples.q, samples.qd, samples.qdd, drives.speeds)
    rows = np.concatenate([regressors, samples.tau[..., None]], axis=2)
    products = block_products(rows, HINTS.blocks)
    return DriveProblem(samples, drives.speeds, rows, products, products[..., -1, -1].mean(axis=1))


@dataclass(frozen=True, eq=False)
class DriveProblem:
    """Hold least squares of the torques of n joints by K parameters, in B blocks of time.

    speeds: C, (n, n), of the motors, by the couplings that are known. rows: (S, n, K + 1), of each joint the columns of
    the parameters and the torque. products: (n, B, K + 1, K + 1), of these. size: (n,) of the squares of the torques.
    """

    samples: DriveSamples
    speeds: np.ndarray
    rows: np.ndarray
    products: np.ndarray
    size: np.ndarray

    @property
    def bodies(self) -> np.ndarray:
        """Return the columns of the bodies' parameters, (S, n, 10 bodies)."""
        return self.rows[..., : -len(FRICTION.effects) * len(self.size) - 1]

    @property
    def is_short(self) -> bool:
        """Whether there are too few samples for a hint."""
        return len(self.rows) < HINTS.fewest_samples

    @property
    def free(self) -> list[int]:
        """Return the joints that no known coupling joins and whose torques vary."""
        joins, tau = self.speeds != 0, self.rows[..., -1]
        # what is no more than a constant with rounding shows nothing
        varies = tau.std(axis=0) > TUNING.negligible * np.abs(tau).max(axis=0)
        return np.flatnonzero(varies & ((joins | joins.T).sum(axis=0) == 1)).tolist()

    def with_rows(self, joints: list[int], rows: np.ndarray) -> DriveProblem:
        """Return the same with other rows (S, k, K + 1) of k joints."""
        products = self.products.copy()
        products[joints] = block_products(rows, products.shape[1])
        return replace(self, products=products)

    def of_torques(self, tau: np.ndarray) -> DriveProblem:
        """Return the same with other torques (S, n)."""
        rows = np.concatenate([self.rows[..., :-1], tau[..., None]], axis=2)
        return replace(self, rows=rows, products=block_products(rows, self.products.shape[1]))

    def in_one_block(self, stride: int) -> DriveProblem:
        """Return the same on one of so many samples, in a single block: it judges by what it was fitted to."""
        rows = self.rows[::stride]
        samples = self.samples.thinned(stride)
        return replace(self, samples=samples, rows=rows, products=block_products(rows, 1))

    @cached_property
    def errors(self) -> np.ndarray:
        """Return squares (B, n) of what is left of each torque in each block, by the torque's squares.

        The parameters are those that fit all other blocks; of a single block, its own.
        """
        products = self.products / np.where(self.size > 0, self.size, 1.0)[:, None, None, None]
        fitted = products.sum(axis=0)
        if len(fitted) > 1:
            fitted = fitted.sum(axis=0) - fitted
        solution = normal_solution(fitted, 1)
        left = np.append(solution, np.full_like(solution[:, :1], -1.0), axis=1)
        errors = left.swapaxes(1, 2) @ products @ left
        # of torques that are explained exactly rounding is left
        return np.asarray(np.maximum(errors[..., 0, 0].T, TUNING.negligible))

    def exchanged(self, joint: int, other: int) -> DriveProblem:
        """Return the problem with the torques of two joints exchanged, of a joint and itself with the opposite sign."""
        rows = self.rows[:, [joint, other]].copy()
        rows[..., -1] = self.rows[:, [other, joint], -1] * (-1 if joint == other else 1)
        size = self.size.copy()
        size[[joint, other]] = size[[other, joint]]
        return replace(self.with_rows([joint, other], rows), size=size)

    def cost(self, coupling: Coupling) -> float:
        """Return what a coupling leaves of the errors of both joints."""
        errors = self.coupled(coupling).errors[:, coupling.pair].mean()
        return float(errors / self.errors[:, coupling.pair].mean())

    def coupled(self, coupling: Coupling) -> DriveProblem:
        """Return the problem where a motor turns with another joint, too."""
        joint, moved_by, ratio = coupling.joint, coupling.moved_by, coupling.ratio
        motion = np.stack([self.samples.qd, self.samples.qdd])
        qd, qdd = motion[..., [joint]] + ratio * motion[..., [moved_by]]
        columns = FRICTION.columns(qd, qdd)[:, 0]  # (S, effects)
        n, effects = self.rows.shape[1], columns.shape[1]
        of_motor = np.arange(effects) * n + joint - effects * n - 1
        rows = self.rows[:, coupling.pair].copy()
        rows[:, 0, of_motor] = columns
        rows[:, 1, of_motor] = ratio * columns
        if coupling.logged_at == "motors":
            rows[:, 1, -1] += ratio * rows[:, 0, -1]
        return self.with_rows(coupling.pair, rows)


def find_wrong_torques(problem: DriveProblem, joints: Sequence[str]) -> WrongTorque | None:
    """Return what is surely wrong with the torques of joints: one of the other sign, or two exchanged."""
    if problem.is_short:
        return None
    coarse = problem.in_one_block(HINTS.coarse)
    candidates = list(combinations_with_replacement(range(len(joints)), 2))
    k, other = min(candidates, key=lambda pair: float(coarse.exchanged(*pair).errors.mean()))
    logged, changed = problem.errors.mean(axis=1), problem.exchanged(k, other).errors.mean(axis=1)
    if not _is_sure(logged, changed, HINTS.wrong_gain, len(candidates)):
        return None
    if k == other:
        return WrongTorque(k, "torque-sense", f"torques of the opposite sign (tau of {joints[k]!r})")
    got = f"the torques of {joints[other]!r}, and that joint has those of {joints[k]!r}"
    return WrongTorque(k, "torque-order", got)


def find_coupling(problem: DriveProblem) -> tuple[Coupling, float] | None:
    """Return the coupling between two neighbours' motors that explains torques best, and what it leaves of the error.

    None: none is sure. Joints that known couplings join are left alone.
    """
    # all pairs on few samples: the ratio need not be exact to stand out
    coarse = problem.in_one_block(HINTS.coarse)
    candidates: list[Coupling] = []
    for joint, moved_by in permutations(problem.free, 2):
        if abs(joint - moved_by) > 1:
            continue  # shafts and belts run along the arm; farther pairs explain springs
        for ratio in HINTS.ratios:
            candidates.append(Coupling(joint, moved_by, ratio, "joints"))
            candidates.append(Coupling(joint, moved_by, ratio, "motors"))
    if problem.is_short or not candidates:
        return None
    nearest = min(candidates, key=coarse.cost)
    best = _with_best_ratio(nearest, problem.in_one_block(1).cost)
    logged = problem.errors[:, best.pair].mean(axis=1)
    coupled = problem.coupled(best).errors[:, best.pair].mean(axis=1)
    # torques that are hardly explained in some block may be anything
    explained = coupled.max() < HINTS.coupling_gain
    if not (explained and _is_sure(logged, coupled, HINTS.coupling_gain, len(candidates))):
        return None
    return best, float(coupled.mean() / logged.mean())


def _with_best_ratio(start: Coupling, cost: Callable[[Coupling], float]) -> Coupling:
    """Return a coupling with the ratio of the least error, one of small numbers where that costs little."""
    bounds = sorted((start.ratio / 2, start.ratio * 2))
    best = minimize_scalar(
        lambda ratio: cost(replace(start, ratio=ratio)),
        bounds=bounds, method="bounded", options={"xatol": abs(start.ratio) / 100},
    )  # fmt: skip
    simple = replace(start, ratio=float(Fraction(float(best.x)).limit_denominator(4)))
    if simple.ratio and cost(simple) <= (1 + HINTS.simple_ratio) * best.fun:
        return simple
    return replace(start, ratio=round(float(best.x), 3))


def _is_sure(logged: np.ndarray, mended: np.ndarray, gain: float, candidates: int) -> bool:
    """Whether errors by block (B,) fell to this part of what they were, and not as the luckiest of some candidates."""
    if mended.mean() >= gain * logged.mean():
        return False
    # between -1 and 1: neither a block that is hard to tell nor one that all but vanishes counts more than others
    gains = (logged - mended) / (logged + mended)
    standard_error = gains.std(ddof=1) / np.sqrt(len(gains))
    # of hundreds of couplings one is always better by chance (Bonferroni's bound)
    needed = -float(stdtrit(len(gains) - 1, HINTS.chance / candidates))
    return bool(gains.mean() > needed * standard_error)
