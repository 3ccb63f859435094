"""Detection of couplings of motors that the settings do not declare, by least squares on a subset of the samples.

The friction model depends on the velocity only. The Gram matrices of the regressor are computed once for all joints; a
candidate for a coupling changes the matrices of two joints only. The best candidate is accepted if it lowers the torque
residual on held-out blocks of time.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property
from itertools import permutations, product
from typing import Literal

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.special import stdtrit

from spelgen.arm.actuation import Drives
from spelgen.dynamics.body_regressor import chain_regressor
from spelgen.dynamics.friction import FrictionModel
from spelgen.errors import Diagnostic
from spelgen.identification.least_squares import block_products, normal_solution, varying
from spelgen.identification.motion_samples import MotionSamples
from spelgen.identification.tuning import HINTS, TUNING
from spelgen.logs.tuning import SAMPLES
from spelgen.runtime.body_chain import BodyChain

FRICTION = FrictionModel(coulomb_smoothing_velocity=SAMPLES.moving)


@dataclass(frozen=True)
class Coupling:
    """Coupling of two joints: the motor of `joint` also rotates when the joint `moved_by` moves.

    The speed of the motor, on the output side of its gear, is qd[joint] + ratio * qd[moved_by]. logged_at: "joints" if
    the logged torques are joint torques; "motors" if they are motor torques on the output side of the gears [Nm, N].
    """

    joint: int
    moved_by: int
    ratio: float
    logged_at: Literal["joints", "motors"]

    @property
    def pair(self) -> list[int]:
        """Indices of the coupled joints: the joint that the motor drives, and the joint that also rotates the motor."""
        return [self.joint, self.moved_by]


def friction_compensated(values: str) -> Diagnostic:
    """Return the warning about torques that decrease with velocity.

    values: text with joint names and their negative viscous friction, or their coefficient of friction compensation.
    """
    message = (
        f"the measured torque decreases with velocity: {values}; friction falls with speed (Stribeck effect), or the "
        "drive compensates friction: check the signs of the torques, and whether the controller subtracts friction"
    )
    return Diagnostic("warning", "friction-compensated", "logs", None, message)


def drive_rows(
    chain: BodyChain, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray, speeds: np.ndarray
) -> np.ndarray:
    """Return the regressor Y (S, n, K) of the joint torques: tau = Y @ parameters at each of S samples.

    The K columns belong to the inertial parameters of the bodies, then to each friction effect of all drives. q, qd,
    qdd: (S, n) [rad, m] and their derivatives with respect to time [s]. speeds: matrix C (n, n) from joint speeds to
    motor speeds, with the declared couplings.
    """
    bodies = chain_regressor(chain, q, qd, qdd)
    return np.concatenate([bodies, FRICTION.columns(qd, qdd, None, speeds)], axis=2)


def bristle_columns(bent: np.ndarray, speeds: np.ndarray) -> np.ndarray:
    """Return the regressor of the deflections of bristles, (S, n, n K), for dry friction with hysteresis.

    By virtual power, the friction of drive j acts on joint i with the factor C_ji.

    Args:
        bent: deflections of K bristles per drive, divided by the break-away displacements, (S, n, K).
        speeds: matrix C (n, n) from joint speeds to motor speeds.
    """
    columns: np.ndarray = bent[:, None] * speeds.T[:, :, None]
    return columns.reshape(*bent.shape[:2], -1)


def drive_problem(chain: BodyChain, drives: Drives, samples: MotionSamples) -> DriveProblem:
    """Return the least-squares problem of the joint torques of `samples`, at their logged times.

    Unknown are the inertial parameters of the bodies and the friction and inertia of the `drives`.
    """
    q, qd, qdd = samples.motion
    regressors = drive_rows(chain, q, qd, qdd, drives.speeds)
    rows = np.concatenate([regressors, samples.tau[..., None]], axis=2)
    products = block_products(rows, HINTS.blocks)
    return DriveProblem(samples, drives.speeds, rows, products, products[..., -1, -1].mean(axis=1))


@dataclass(frozen=True, eq=False)
class DriveProblem:
    """Least-squares problem of the torques of n joints with K parameters, in B blocks of time.

    Attributes:
        samples: the S samples.
        speeds: matrix C (n, n) from joint speeds to motor speeds, with the declared couplings.
        rows: (S, n, K + 1) regressor and torque of each joint.
        products: (n, B, K + 1, K + 1) Gram matrices of the rows, per joint and block.
        size: (n,) mean over the blocks of the sum of squared torques in a block.
    """

    samples: MotionSamples
    speeds: np.ndarray
    rows: np.ndarray
    products: np.ndarray
    size: np.ndarray

    @property
    def bodies(self) -> np.ndarray:
        """Columns of the regressor that belong to the inertial parameters of the bodies, (S, n, 10 bodies)."""
        return self.rows[..., : -len(FRICTION.effects) * len(self.size) - 1]

    @property
    def free(self) -> list[int]:
        """Indices of the joints for which a coupling is searched: none declared, motion, and a torque that varies.

        A joint at rest is omitted: dry friction carries a part of its load, and its neighbours shake it.
        """
        joins = self.speeds != 0
        is_single = (joins | joins.T).sum(axis=0) == 1
        return np.flatnonzero(varying(self.rows[..., -1]) & self.samples.moving_joints & is_single).tolist()

    def of_torques(self, tau: np.ndarray) -> DriveProblem:
        """Return the least-squares problem with other joint torques, tau (S, n) [Nm, N], e.g. without a delay."""
        rows = np.concatenate([self.rows[..., :-1], tau[..., None]], axis=2)
        return replace(self, rows=rows, products=block_products(rows, self.products.shape[1]))

    def in_one_block(self, stride: int) -> DriveProblem:
        """Return the least-squares problem on every `stride`-th sample, in a single block of time.

        No samples are held out, and fewer samples save time.
        """
        rows = self.rows[::stride]
        return replace(self, samples=self.samples.every(stride), rows=rows, products=block_products(rows, 1))

    def with_hysteresis(self) -> DriveProblem:
        """Return the least-squares problem with the deflections of bristles as additional columns of the regressor.

        The dry friction of this problem depends on the past motion. The new columns are after the columns of the
        bodies.
        """
        drives = len(FRICTION.effects) * len(self.size) + 1
        bristles = bristle_columns(self.samples.bent, self.speeds)
        rows = np.concatenate([self.rows[..., :-drives], bristles, self.rows[..., -drives:]], axis=2)
        return replace(self, rows=rows, products=block_products(rows, self.products.shape[1]))

    @cached_property
    def errors(self) -> np.ndarray:
        """Relative squared torque residual (B, n) [1] of each of n joints in each of B blocks of samples.

        The sum of squared residuals in a block is divided by `size`, the mean over the blocks of the sum of squared
        torques. The parameters are fitted to all other blocks; with a single block, they are fitted to this block.
        """
        products = self.products / np.where(self.size > 0, self.size, 1.0)[:, None, None, None]
        fitted = products.sum(axis=0)
        if len(fitted) > 1:
            fitted = fitted.sum(axis=0) - fitted
        solution = normal_solution(fitted, 1)
        left = np.append(solution, np.full_like(solution[:, :1], -1.0), axis=1)
        errors = left.swapaxes(1, 2) @ products @ left
        # the errors are bounded from below, since they are divisors: the residual of an exact model consists of
        # rounding errors
        return np.asarray(np.maximum(errors[..., 0, 0].T, TUNING.negligible))

    def cost(self, coupling: Coupling) -> float:
        """Return the squared torque residual of two coupled joints, divided by the residual without their coupling."""
        errors = self.coupled(coupling).errors[:, coupling.pair].mean()
        return float(errors / self.errors[:, coupling.pair].mean())

    def coupled(self, coupling: Coupling) -> DriveProblem:
        """Return the least-squares problem of a model in which the motors of two joints are coupled.

        Only the Gram matrices of both coupled joints are recomputed; `rows` remains the regressor without the coupling.
        """
        joint, moved_by, ratio = coupling.joint, coupling.moved_by, coupling.ratio
        motion = self.samples.motion[1:]
        qd, qdd = motion[..., [joint]] + ratio * motion[..., [moved_by]]
        columns = FRICTION.columns(qd, qdd)[:, 0]  # (S, effects): friction and inertia of the motor
        n, effects = self.rows.shape[1], columns.shape[1]
        of_motor = np.arange(effects) * n + joint - effects * n - 1
        rows = self.rows[:, coupling.pair].copy()
        rows[:, 0, of_motor] = columns
        rows[:, 1, of_motor] = ratio * columns
        if coupling.logged_at == "motors":
            rows[:, 1, -1] += ratio * rows[:, 0, -1]
        products = self.products.copy()
        products[coupling.pair] = block_products(rows, products.shape[1])
        return replace(self, products=products)


def find_coupling(problem: DriveProblem) -> tuple[Coupling, float] | None:
    """Return the coupling of two neighbouring joints that lowers the torque residual most; None if none is significant.

    The second value is the squared torque residual of both joints with the coupling, divided by the residual without
    it. Joints with a declared coupling are omitted.
    """
    # all pairs of joints are compared on every fourth sample with three speed ratios, which suffices to find the best
    # pair
    coarse = problem.in_one_block(4)
    candidates: list[Coupling] = []
    for joint, moved_by in permutations(problem.free, 2):
        if abs(joint - moved_by) > 1:
            # Only neighbours are tried, which shafts and belts couple; fits of other pairs explain other effects, such
            # as springs.
            continue
        # three magnitudes of the ratio of motor speed to the speed of the joint `moved_by` are tried; the best one is
        # refined later, within half to twice its value
        for ratio, sign in product((0.4, 1.0, 2.5), (1.0, -1.0)):
            candidates.append(Coupling(joint, moved_by, sign * ratio, "joints"))
            candidates.append(Coupling(joint, moved_by, sign * ratio, "motors"))
    if len(problem.rows) < HINTS.fewest_samples or not candidates:
        return None
    nearest = min(candidates, key=coarse.cost)
    best = _with_best_ratio(nearest, problem.in_one_block(1).cost)
    logged = problem.errors[:, best.pair].mean(axis=1)
    coupled = problem.coupled(best).errors[:, best.pair].mean(axis=1)
    # The coupling is rejected if the model with it has a large error in any block: such a model does not explain the
    # torques, and a smaller error than without the coupling is no evidence.
    explained = coupled.max() < HINTS.coupling_gain
    if not (explained and _is_sure(logged, coupled, HINTS.coupling_gain, len(candidates))):
        return None
    # The torque residual so far is of a friction model without a state (hysteresis), which has errors after each
    # reversal of a joint. If both joints reverse at the same times, a coupling explains these errors, too. A coupling
    # is therefore accepted only if it also lowers the residual of the friction model with hysteresis.
    stateful = problem.with_hysteresis()
    without, with_coupling = (x.errors[:, best.pair].mean(axis=1) for x in (stateful, stateful.coupled(best)))
    if not _is_sure(without, with_coupling, HINTS.coupling_gain, 1):
        return None
    return best, float(coupled.mean() / logged.mean())


def _with_best_ratio(start: Coupling, cost: Callable[[Coupling], float]) -> Coupling:
    """Return the coupling `start` with the ratio of minimum cost, between half and twice the ratio of `start`.

    A fraction of small integers near the minimum is preferred if its cost is at most 2 % higher.
    """
    bounds = sorted((start.ratio / 2, start.ratio * 2))
    best = minimize_scalar(
        lambda ratio: cost(replace(start, ratio=ratio)),
        bounds=bounds, method="bounded", options={"xatol": abs(start.ratio) / 100},
    )  # fmt: skip
    simple = replace(start, ratio=float(Fraction(float(best.x)).limit_denominator(4)))
    if simple.ratio and cost(simple) <= 1.02 * best.fun:
        return simple
    return replace(start, ratio=round(float(best.x), 3))


def _is_sure(logged: np.ndarray, mended: np.ndarray, gain: float, candidates: int) -> bool:
    """Return True if a coupling significantly lowers the errors of B blocks of time (one-sided t test).

    Args:
        logged: (B,) errors without the coupling.
        mended: (B,) errors with the coupling.
        gain: upper bound for the ratio (mean error with the coupling) / (mean error without it).
        candidates: number of couplings of which this one is the best; the significance level is divided by it.
    """
    if mended.mean() >= gain * logged.mean():
        return False
    # `gains`: error decrease of each block, divided by the sum of its errors without and with the candidate; the values
    # are between -1 and 1, so that no single block dominates their mean
    gains = (logged - mended) / (logged + mended)
    standard_error = gains.std(ddof=1) / np.sqrt(len(gains))
    # The best of hundreds of candidates is always better by chance. The significance level of 1/400 is therefore
    # divided by the number of candidates (Bonferroni correction).
    needed = -float(stdtrit(len(gains) - 1, 1 / 400 / candidates))
    return bool(gains.mean() > needed * standard_error)
