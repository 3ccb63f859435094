"""Find what logs show of drives that no file says: motors that move several joints, and wrong torques.

Both are asked of least squares with friction without memory, on samples of all logs, thinned. The products of its
columns are formed once; a candidate has other columns of one or two joints. The best candidate counts if it explains
the torques better in blocks of time that the parameters were not fitted to.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property
from itertools import combinations_with_replacement, permutations
from typing import TYPE_CHECKING, Literal

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.stats import t as student

from spelgen.arm.arm import Arm
from spelgen.dynamics.regressor import regressor
from spelgen.errors import Diagnostic
from spelgen.identification.base_parameters import base_parameters
from spelgen.identification.drive_samples import DriveSamples
from spelgen.identification.friction import FrictionModel
from spelgen.identification.least_squares import block_products
from spelgen.logs.preprocessing import COUPLED
from spelgen.settings.tuning.identification import DriveHintTuning, IdentificationTuning

if TYPE_CHECKING:
    from spelgen.loaded_arm import LoadedArm

TUNING = DriveHintTuning()
FRICTION = FrictionModel(coulomb_smoothing_velocity=IdentificationTuning().moving)
NEGLIGIBLE = IdentificationTuning().negligible

LoggedAt = Literal["joints", "motors"]


@dataclass(frozen=True)
class Coupling:
    """The motor of `joint` turns `ratio` times as fast with `moved_by` beside its own joint.

    logged_at: whether the logged torques are those of the joints, or of the motors (in the joints' units).
    """

    joint: int
    moved_by: int
    ratio: float
    logged_at: LoggedAt

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
    arm: Arm, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray, speeds: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the regressor (S, n, K) of the parameters that torques show, at q, qd and qdd, each (S, n).

    Beside it of each parameter (K,) the number of its friction column, below zero those of bodies: effect e of drive j
    has n e + j. speeds: C, (n, n), of the motors, by the couplings that are known.
    """
    bodies = regressor(arm, q, qd, qdd)
    friction = FRICTION.columns(qd, qdd, None, speeds)
    columns = base_parameters(arm, FRICTION, speeds).columns
    return np.concatenate([bodies, friction], axis=2)[..., columns], columns - bodies.shape[2]


def drive_problem(arm: LoadedArm, samples: DriveSamples) -> DriveProblem | None:
    """Return least squares of the joint torques; None where there are too few samples."""
    if len(samples.q) < TUNING.fewest_samples:
        return None
    speeds, tau = arm.actuation.drives().speeds, samples.tau
    regressors, numbers = drive_rows(arm.arm, samples.q, samples.qd, samples.qdd, speeds)
    rows = np.concatenate([regressors, tau[..., None]], axis=2)
    is_coupled = ((speeds != 0) | (speeds != 0).T).sum(axis=0) > 1
    # what is no more than a constant with rounding shows nothing
    varies = tau.std(axis=0) > NEGLIGIBLE * np.abs(tau).max(axis=0)
    free = np.flatnonzero(varies & ~is_coupled).tolist()
    products = block_products(rows, TUNING.blocks)
    motion = np.stack([samples.qd, samples.qdd])
    return DriveProblem(motion, rows, products, products[..., -1, -1].mean(axis=1), numbers, free)


@dataclass(frozen=True, eq=False)
class DriveProblem:
    """Hold least squares of the torques of n joints by K parameters, in B blocks of time.

    motion: qd and qdd, (2, S, n). rows: (S, n, K + 1), of each joint the columns of the parameters and the torque.
    products: (n, B, K + 1, K + 1), of these. size: (n,) of the squares of the torques. numbers: see `drive_rows`. free:
    the joints that no known coupling joins and whose torques vary.
    """

    motion: np.ndarray
    rows: np.ndarray
    products: np.ndarray
    size: np.ndarray
    numbers: np.ndarray
    free: list[int]

    def with_rows(self, joints: list[int], rows: np.ndarray) -> DriveProblem:
        """Return the same with other rows (S, k, K + 1) of k joints."""
        products = self.products.copy()
        products[joints] = block_products(rows, products.shape[1])
        return replace(self, products=products)

    def in_one_block(self, stride: int) -> DriveProblem:
        """Return the same on one of so many samples, in a single block: it judges by what it was fitted to."""
        rows = self.rows[::stride]
        return replace(self, motion=self.motion[:, ::stride], rows=rows, products=block_products(rows, 1))

    @cached_property
    def errors(self) -> np.ndarray:
        """Return squares (B, n) of what is left of each torque in each block, by the torque's squares.

        The parameters are those that fit all other blocks; of a single block, its own.
        """
        products = self.products / np.where(self.size > 0, self.size, 1.0)[:, None, None, None]
        fitted = products.sum(axis=0)
        if len(fitted) > 1:
            fitted = fitted.sum(axis=0) - fitted
        # kilograms and kilogram square metres, in columns of one length: products square the spread
        length = np.sqrt(np.diagonal(fitted, axis1=1, axis2=2))[..., None]
        length = np.where(length > 0, length, 1.0)
        fitted = fitted / (length * length.swapaxes(1, 2)) + NEGLIGIBLE * np.eye(length.shape[1])
        left = np.full(length.shape, -1.0)
        left[:, :-1] = np.linalg.solve(fitted[:, :-1, :-1], fitted[:, :-1, -1:])
        left *= length[:, -1:] / length
        errors = left.swapaxes(1, 2) @ products @ left
        # of torques that are explained exactly rounding is left
        return np.asarray(np.maximum(errors[..., 0, 0].T, NEGLIGIBLE))

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
        qd, qdd = self.motion[..., [joint]] + ratio * self.motion[..., [moved_by]]
        n = self.rows.shape[1]
        of_motor = np.flatnonzero((self.numbers >= 0) & (self.numbers % n == joint))
        columns = FRICTION.columns(qd, qdd)[:, 0, self.numbers[of_motor] // n]
        rows = self.rows[:, coupling.pair].copy()
        rows[:, 0, of_motor] = columns
        rows[:, 1, of_motor] = ratio * columns
        if coupling.logged_at == "motors":
            rows[:, 1, -1] += ratio * rows[:, 0, -1]
        return self.with_rows(coupling.pair, rows)


def find_wrong_torques(problem: DriveProblem, joints: Sequence[str]) -> WrongTorque | None:
    """Return what is surely wrong with the torques of joints: one of the other sign, or two exchanged."""
    coarse = problem.in_one_block(TUNING.coarse)
    candidates = list(combinations_with_replacement(range(len(joints)), 2))
    k, other = min(candidates, key=lambda pair: float(coarse.exchanged(*pair).errors.mean()))
    logged, changed = problem.errors.mean(axis=1), problem.exchanged(k, other).errors.mean(axis=1)
    if not _is_sure(logged, changed, TUNING.wrong_gain, len(candidates)):
        return None
    if k == other:
        return WrongTorque(k, "torque-sense", f"torques of the opposite sign (tau of {joints[k]!r})")
    got = f"the torques of {joints[other]!r}, and that joint has those of {joints[k]!r}"
    return WrongTorque(k, "torque-order", got)


def find_coupling(problem: DriveProblem) -> tuple[Coupling, float] | None:
    """Return the coupling between two joints' motors that explains torques best, and what it leaves of the error.

    None: none is sure. Joints that known couplings join are left alone.
    """
    # all pairs on few samples: the ratio need not be exact to stand out
    coarse = problem.in_one_block(TUNING.coarse)
    candidates: list[Coupling] = []
    for joint, moved_by in permutations(problem.free, 2):
        for ratio in TUNING.ratios:
            candidates.append(Coupling(joint, moved_by, ratio, "joints"))
            candidates.append(Coupling(joint, moved_by, ratio, "motors"))
    if not candidates:
        return None
    nearest = min(candidates, key=coarse.cost)
    best = _with_best_ratio(nearest, problem.in_one_block(1).cost)
    logged = problem.errors[:, best.pair].mean(axis=1)
    coupled = problem.coupled(best).errors[:, best.pair].mean(axis=1)
    if not _is_sure(logged, coupled, TUNING.coupling_gain, len(candidates)):
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
    if simple.ratio and cost(simple) <= (1 + TUNING.simple_ratio) * best.fun:
        return simple
    return replace(start, ratio=round(float(best.x), 3))


def _is_sure(logged: np.ndarray, mended: np.ndarray, gain: float, candidates: int) -> bool:
    """Whether errors by block (B,) fell to this part of what they were, and not as the luckiest of some candidates."""
    if mended.mean() >= gain * logged.mean():
        return False
    ratios = np.log(logged / mended)  # by factors: a block that is hard to tell counts as any other
    standard_error = ratios.std(ddof=1) / np.sqrt(len(ratios))
    # of hundreds of couplings one is always better by chance (Bonferroni's bound)
    needed = float(student.isf(TUNING.chance / candidates, len(ratios) - 1))
    return bool(ratios.mean() > needed * standard_error)


def coupling_hint(arm: LoadedArm, coupling: Coupling, remaining: float) -> Diagnostic:
    """Return a coupling that the logs show, in the sidecar's words."""
    names = arm.arm.joint_names
    pair = [coupling.moved_by, coupling.joint]
    matrix = np.array([[1.0, coupling.ratio], [0.0, 1.0]]) * np.diag(arm.actuation.matrix())[pair]
    joints = json.dumps([names[k] for k in pair])
    setting = f"couplings: [{{joints: {joints}, matrix: {matrix.round(6).tolist()}}}]"
    if coupling.logged_at == "motors" and arm.settings.torque == "joint":
        uncoupled = [name for k, name in enumerate(names) if k not in pair]
        gears = ", ".join(f"{json.dumps(name)}: {{gear: 1}}" for name in uncoupled)
        setting += f", 'torque: motor' and joints: {{{gears}}}"
    message = (
        f"its motor turns with {names[coupling.moved_by]!r} too, {coupling.ratio:g} times as fast, and the logged "
        f"torques are those of the {coupling.logged_at}: least squares then misses {remaining:.0%} of what it missed "
        f"of both torques (mean square); say {setting} in the robot's YAML"
    )
    return Diagnostic("warning", COUPLED, f"joint {names[coupling.joint]!r}", None, message)
