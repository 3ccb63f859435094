"""Detection of undeclared couplings of motors, by least squares with rate-only friction on a subset of all samples.

The Gram matrices of the regressor are computed once; a candidate changes the columns of two joints only. The best
candidate is accepted if it lowers the torque residual on held-out blocks of time.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property
from itertools import permutations, product
from typing import Literal, NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.optimize import minimize_scalar
from scipy.special import stdtrit

from spelgen.arm.actuation import Drives
from spelgen.dynamics.body_regressor import chain_regressor
from spelgen.dynamics.bristles import reach_of
from spelgen.dynamics.friction import FrictionModel
from spelgen.identification.least_squares import block_products, normal_solution, varying
from spelgen.identification.tuning import HINTS, TUNING
from spelgen.logs.dynamics_samples import (
    FREQUENCY,
    SHORTEST,
    DynamicsSamples,
    dynamics_samples,
    is_moving,
    long_pieces,
)
from spelgen.logs.preprocessing import Preprocessing
from spelgen.logs.trajectory import Trajectory
from spelgen.logs.tuning import SAMPLES
from spelgen.runtime.body_chain import BodyChain

FRICTION = FrictionModel(coulomb_smoothing_velocity=SAMPLES.moving)
STEPS = max(HINTS.shifts)
SHIFTS = np.array(HINTS.shifts) / FREQUENCY  # [s]


class DriveSamples(NamedTuple):
    """S samples of moving joints with their torques.

    q, qd, qdd: (S, n) [rad, m, s]. bent: (S, n, K), bristle deflection divided by the break-away displacement.
    direction: (S, n), see `DynamicsSamples`. torques: (S, n, D) [Nm, N], shifted by each of the D `SHIFTS`.
    """

    q: np.ndarray
    qd: np.ndarray
    qdd: np.ndarray
    bent: np.ndarray
    direction: np.ndarray
    torques: np.ndarray

    @property
    def tau(self) -> np.ndarray:
        """Return the torques without shift, (S, n) [Nm, N]."""
        return self.torques[..., STEPS]

    def thinned(self, stride: int) -> DriveSamples:
        """Return every `stride`-th sample."""
        return DriveSamples(*(column[::stride] for column in self))


class DriveLog:
    """Collector of samples of successive trajectories, evenly subsampled to at most twice `DriveHintTuning.samples`.

    Of many trajectories only every second, fourth, ... is used, since filtering all of a long log takes minutes.
    """

    def __init__(self, joint_types: Sequence[str], drives: Drives, preprocessing: Preprocessing) -> None:
        """Create a collector without samples.

        Args:
            joint_types: of the n joints.
            drives: inputs and speeds of the drives.
            preprocessing: its filter and gap are used.
        """
        self._inputs, self._preprocessing = drives.inputs, replace(preprocessing, torque_delay=0.0)
        smoothing = np.full(len(joint_types), FrictionModel().coulomb_smoothing_velocity)
        self._reach = replace(reach_of(joint_types, drives.speeds), smoothing_velocity=smoothing)
        self._samples: list[DriveSamples] = []
        self._every = self._step = 1
        self._number = 0

    def add(self, trajectory: Trajectory) -> None:
        """Add the samples of a trajectory that is dense and long enough for accelerations."""
        # most of ten thousand short motions are skipped before they are filtered
        if trajectory.duration < SHORTEST:
            return
        self._number += 1
        if self._number % self._step:
            return
        for piece in long_pieces(trajectory, self._preprocessing.gap):
            # pauses included: at a constant rate a filtered torque is shifted by whole samples
            samples = dynamics_samples(
                [piece], pauses=True, preprocessing=self._preprocessing, reach=self._reach
            )
            self._samples += [self._shifted(x).thinned(self._every) for x in samples if len(x.q) > 2 * STEPS]
        while self._count > 2 * HINTS.samples:
            if len(self._samples) > HINTS.trajectories:
                self._samples = self._samples[1::2]
                self._step *= 2
            else:
                self._samples = [x.thinned(2) for x in self._samples]
                self._every *= 2

    def _shifted(self, samples: DynamicsSamples) -> DriveSamples:
        """Return the moving samples at a constant rate, without the ends, which have no shifted torques."""
        inner = samples[STEPS:-STEPS]
        assert inner.z is not None and inner.direction is not None
        torques = sliding_window_view(samples.tau @ self._inputs.T, len(SHIFTS), axis=0)
        columns = (inner.q, inner.qd, inner.qdd, inner.z / self._reach.values, inner.direction, torques)
        moving = is_moving(inner.qd)
        return DriveSamples(*(column[moving] for column in columns))

    @property
    def _count(self) -> int:
        return sum(len(x.q) for x in self._samples)

    def samples(self) -> DriveSamples | None:
        """Return all samples, or None if no joint moves."""
        if not self._count:
            return None
        columns = zip(*self._samples, strict=True)
        return DriveSamples(*map(np.concatenate, columns)).thinned(-(-self._count // HINTS.samples))


@dataclass(frozen=True)
class Coupling:
    """Coupling of two joints: the motor of `joint` rotates with its own joint and, `ratio` times as fast, with
    `moved_by`.

    logged_at: whether logged torques act at the joints, or at the motors (in the units of the joints).
    """

    joint: int
    moved_by: int
    ratio: float
    logged_at: Literal["joints", "motors"]

    @property
    def pair(self) -> list[int]:
        """Return both joints."""
        return [self.joint, self.moved_by]


def drive_rows(
    chain: BodyChain, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray, speeds: np.ndarray
) -> np.ndarray:
    """Return the regressor (S, n, K): columns of the bodies, then of each friction effect for all drives.

    q, qd, qdd: (S, n) [rad, m], per s, per s^2. speeds: C, (n, n), of the motors with the declared couplings.
    """
    bodies = chain_regressor(chain, q, qd, qdd)
    return np.concatenate([bodies, FRICTION.columns(qd, qdd, None, speeds)], axis=2)


def drive_problem(chain: BodyChain, drives: Drives, samples: DriveSamples) -> DriveProblem:
    """Return the least-squares problem of the joint torques of samples."""
    regressors = drive_rows(chain, samples.q, samples.qd, samples.qdd, drives.speeds)
    rows = np.concatenate([regressors, samples.tau[..., None]], axis=2)
    products = block_products(rows, HINTS.blocks)
    return DriveProblem(samples, drives.speeds, rows, products, products[..., -1, -1].mean(axis=1))


@dataclass(frozen=True, eq=False)
class DriveProblem:
    """Least-squares problem of the torques of n joints with K parameters, in B blocks of time.

    speeds: C, (n, n), of the motors with the declared couplings. rows: (S, n, K + 1), regressor and torque of each
    joint.
    products: (n, B, K + 1, K + 1), their Gram matrices. size: (n,), sums of the squared torques.
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
    def free(self) -> list[int]:
        """Return the joints without a declared coupling whose torques vary."""
        joins = self.speeds != 0
        return np.flatnonzero(varying(self.rows[..., -1]) & ((joins | joins.T).sum(axis=0) == 1)).tolist()

    def of_torques(self, tau: np.ndarray) -> DriveProblem:
        """Return the problem with other torques (S, n)."""
        rows = np.concatenate([self.rows[..., :-1], tau[..., None]], axis=2)
        return replace(self, rows=rows, products=block_products(rows, self.products.shape[1]))

    def in_one_block(self, stride: int) -> DriveProblem:
        """Return the problem on every `stride`-th sample, in one block, on which it is fitted and evaluated."""
        rows = self.rows[::stride]
        samples = self.samples.thinned(stride)
        return replace(self, samples=samples, rows=rows, products=block_products(rows, 1))

    @cached_property
    def errors(self) -> np.ndarray:
        """Return the squared residual (B, n) of each torque in each block, divided by the squared torque.

        The parameters are fitted to all other blocks; a single block is fitted itself.
        """
        products = self.products / np.where(self.size > 0, self.size, 1.0)[:, None, None, None]
        fitted = products.sum(axis=0)
        if len(fitted) > 1:
            fitted = fitted.sum(axis=0) - fitted
        solution = normal_solution(fitted, 1)
        left = np.append(solution, np.full_like(solution[:, :1], -1.0), axis=1)
        errors = left.swapaxes(1, 2) @ products @ left
        # the residual of an exact model consists of rounding errors
        return np.asarray(np.maximum(errors[..., 0, 0].T, TUNING.negligible))

    def cost(self, coupling: Coupling) -> float:
        """Return the squared residual of both joints with a coupling, divided by the one without it."""
        errors = self.coupled(coupling).errors[:, coupling.pair].mean()
        return float(errors / self.errors[:, coupling.pair].mean())

    def coupled(self, coupling: Coupling) -> DriveProblem:
        """Return the problem with an additional coupling."""
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
        products = self.products.copy()
        products[coupling.pair] = block_products(rows, products.shape[1])
        return replace(self, products=products)


def find_coupling(problem: DriveProblem) -> tuple[Coupling, float] | None:
    """Return the coupling of two neighbouring joints with the smallest residual, and its error ratio; None if no
    coupling is significant.

    Joints with a declared coupling are not searched.
    """
    # all pairs on few samples: an approximate ratio suffices to detect a coupling
    coarse = problem.in_one_block(4)
    candidates: list[Coupling] = []
    for joint, moved_by in permutations(problem.free, 2):
        if abs(joint - moved_by) > 1:
            continue  # shafts and belts run along the arm; farther pairs explain springs
        # each initial ratio covers half to twice its value
        for ratio, sign in product((0.4, 1.0, 2.5), (1.0, -1.0)):
            candidates.append(Coupling(joint, moved_by, sign * ratio, "joints"))
            candidates.append(Coupling(joint, moved_by, sign * ratio, "motors"))
    if len(problem.rows) < HINTS.fewest_samples or not candidates:
        return None
    nearest = min(candidates, key=coarse.cost)
    best = _with_best_ratio(nearest, problem.in_one_block(1).cost)
    logged = problem.errors[:, best.pair].mean(axis=1)
    coupled = problem.coupled(best).errors[:, best.pair].mean(axis=1)
    # no evidence if the coupled model has a large error in any block: then neither model explains the torques
    explained = coupled.max() < HINTS.coupling_gain
    if not (explained and _is_sure(logged, coupled, HINTS.coupling_gain, len(candidates))):
        return None
    return best, float(coupled.mean() / logged.mean())


def _with_best_ratio(start: Coupling, cost: Callable[[Coupling], float]) -> Coupling:
    """Return a coupling with the ratio of minimum cost, or with a close ratio of small integers at about this cost."""
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
    """Return True if errors per block (B,) fell below the fraction `gain`, significantly for the best candidate."""
    if mended.mean() >= gain * logged.mean():
        return False
    # between -1 and 1, so that no single block dominates
    gains = (logged - mended) / (logged + mended)
    standard_error = gains.std(ddof=1) / np.sqrt(len(gains))
    # Of hundreds of couplings one is always better by chance: 1 in 400 for all candidates, as for terms of a fit
    # (Bonferroni's bound).
    needed = -float(stdtrit(len(gains) - 1, 1 / 400 / candidates))
    return bool(gains.mean() > needed * standard_error)
