"""Find what logs show of drives that no file says: motors that move several joints, and wrong torques.

Both are asked of least squares with friction without memory, on samples of all logs, thinned: would the torques be
explained better, in blocks of time that the parameters were not fitted to?
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import combinations
from typing import TYPE_CHECKING, Literal

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.stats import t as student

from spelgen.arm.actuation import Drives
from spelgen.arm.arm import Arm
from spelgen.dynamics.regressor import regressor
from spelgen.errors import Diagnostic
from spelgen.identification.base_parameters import base_parameters
from spelgen.identification.drive_samples import DriveLog, DriveSamples
from spelgen.identification.friction import FrictionModel
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


@dataclass(frozen=True)
class WrongTorque:
    """Say why the torques of a joint cannot be right: `code` of what may be accepted, `got` in an error."""

    joint: int
    code: str
    got: str


def drive_problem(arm: LoadedArm, log: DriveLog) -> DriveProblem | None:
    """Return least squares of the joint torques that were collected; None where there are too few samples."""
    samples = log.samples()
    if samples is None:
        return None
    return make_problem(arm.arm, samples, arm.actuation.drives().speeds)


@dataclass(frozen=True, eq=False)
class DriveProblem:
    """Least squares of joint torques: rows (S, n, K) of the regressor, of the parameters that the torques show.

    drive_of, effect_of: of each parameter (K,) the drive it belongs to, below zero those of bodies, and its effect.
    speeds: C, (n, n), of the motors, by the couplings that are known.
    """

    samples: DriveSamples
    rows: np.ndarray
    drive_of: np.ndarray
    effect_of: np.ndarray
    speeds: np.ndarray

    @property
    def tau(self) -> np.ndarray:
        """Torques as logged, (S, n)."""
        return self.samples.tau

    def thinned(self, stride: int) -> DriveProblem:
        """Return the problem on one of so many samples."""
        samples, rows = self.samples.thinned(stride), self.rows[::stride]
        return DriveProblem(samples, rows, self.drive_of, self.effect_of, self.speeds)

    def coupled_rows(self, coupling: Coupling) -> np.ndarray:
        """Return the rows where a motor turns with another joint, too, (S, n, K)."""
        joint, moved_by, ratio = coupling.joint, coupling.moved_by, coupling.ratio
        qd = self.samples.qd[:, [joint]] + ratio * self.samples.qd[:, [moved_by]]
        qdd = self.samples.qdd[:, [joint]] + ratio * self.samples.qdd[:, [moved_by]]
        of_motor = np.flatnonzero(self.drive_of == joint)
        columns = FRICTION.columns(qd, qdd)[:, 0, self.effect_of[of_motor]]
        rows = self.rows.copy()
        rows[:, joint, of_motor] = columns
        rows[:, moved_by, of_motor] = ratio * columns
        if coupling.logged_at == "motors":
            rows[:, moved_by] -= ratio * rows[:, joint]
        return rows


def make_problem(arm: Arm, samples: DriveSamples, speeds: np.ndarray) -> DriveProblem:
    """Return the problem of samples of an arm. speeds: C, (n, n), of the motors, by the couplings that are known."""
    bodies = regressor(arm, samples.q, samples.qd, samples.qdd)
    friction = FRICTION.columns(samples.qd, samples.qdd, None, speeds)
    columns = base_parameters(arm, FRICTION, speeds).columns
    rows = np.concatenate([bodies, friction], axis=2)[..., columns]
    # effect e of drive j is friction column n e + j
    number = columns - bodies.shape[2]
    n = len(speeds)
    return DriveProblem(samples, rows, np.where(number < 0, -1, number % n), number // n, speeds)


def held_out_errors(rows: np.ndarray, tau: np.ndarray) -> np.ndarray:
    """Return mean squares (B, n) of what rows (S, n, K) leave of torques (S, n) in each of B blocks of time.

    In units of each torque's variance, with the parameters that fit all other blocks.
    """
    unit = np.where(_varies(tau), tau.std(axis=0), 1.0)
    rows, tau = rows / unit[:, None], tau / unit
    # kilograms and kilogram square metres, in columns of one length: normal equations square the spread
    length = np.linalg.norm(rows, axis=(0, 1))
    rows = rows / np.where(length > 0, length, 1.0)
    row_blocks, tau_blocks = np.array_split(rows, TUNING.blocks), np.array_split(tau, TUNING.blocks)
    squares, products = [], []
    for block, torques in zip(row_blocks, tau_blocks, strict=True):
        flat = block.reshape(-1, rows.shape[2])
        squares.append(flat.T @ flat)
        products.append(flat.T @ torques.ravel())
    all_squares, all_products = sum(squares), sum(products)
    errors = []
    for k, (block, torques) in enumerate(zip(row_blocks, tau_blocks, strict=True)):
        other_squares = all_squares - squares[k] + NEGLIGIBLE * np.eye(len(length))
        parameters = np.linalg.solve(other_squares, all_products - products[k])
        errors.append(np.square(block @ parameters - torques).mean(axis=0))
    return np.stack(errors)


def find_wrong_torques(problem: DriveProblem, joints: Sequence[str]) -> list[WrongTorque]:
    """Return what is surely wrong with the torques of joints: two of them swapped, one of the other sign."""
    count = len(joints)
    changes = {(k, k): f"torques of the opposite sign (tau of {name!r})" for k, name in enumerate(joints)}
    for k, other in combinations(range(count), 2):
        changes[k, other] = f"the torques of {joints[other]!r}, and that joint has those of {joints[k]!r}"
    logged = held_out_errors(problem.rows, problem.tau)
    results: list[tuple[float, WrongTorque]] = []
    for (k, other), got in changes.items():
        tau = problem.tau.copy()
        tau[:, [k, other]] = tau[:, [other, k]] if k != other else -tau[:, [k, other]]
        changed = held_out_errors(problem.rows, tau)
        if _is_sure(logged.mean(axis=1), changed.mean(axis=1), TUNING.wrong_gain, len(changes)):
            code = "torque-sense" if k == other else "torque-order"
            results.append((float(changed.mean()), WrongTorque(k, code, got)))
    # of several changes the best is told
    return [result for _, result in sorted(results, key=lambda result: result[0])[:1]]


def find_coupling(problem: DriveProblem) -> tuple[Coupling, float] | None:
    """Return the coupling between two joints' motors that explains torques best, and what it leaves of the error.

    None: none is sure. Joints that known couplings join are left alone.
    """
    # all pairs on few samples, then the best of them on all: the ratio need not be exact to stand out
    coarse = problem.thinned(TUNING.coarse)
    cost: dict[Coupling, float] = {}
    plain = held_out_errors(coarse.rows, coarse.tau)
    for candidate in _candidates(problem):
        pair = [candidate.joint, candidate.moved_by]
        errors = held_out_errors(coarse.coupled_rows(candidate), coarse.tau)
        cost[candidate] = errors[:, pair].mean() / max(plain[:, pair].mean(), NEGLIGIBLE)
    plain = held_out_errors(problem.rows, problem.tau)
    results: list[tuple[Coupling, float]] = []
    for candidate in sorted(cost, key=cost.__getitem__)[: TUNING.refined]:
        pair = [candidate.joint, candidate.moved_by]
        separate = plain[:, pair].mean(axis=1)
        coupling = _with_best_ratio(problem, candidate)
        coupled = held_out_errors(problem.coupled_rows(coupling), problem.tau)[:, pair].mean(axis=1)
        if _is_sure(separate, coupled, TUNING.coupling_gain, len(cost)):
            results.append((coupling, float(coupled.mean() / separate.mean())))
    return min(results, key=lambda result: result[1], default=None)


def _candidates(problem: DriveProblem) -> Iterator[Coupling]:
    """Yield the couplings that the search begins with."""
    is_known = (problem.speeds != 0) | (problem.speeds != 0).T
    free = np.flatnonzero((is_known.sum(axis=0) == 1) & _varies(problem.tau)).tolist()
    for joint in free:
        for moved_by in free:
            if joint != moved_by:
                for ratio in TUNING.ratios:
                    yield Coupling(joint, moved_by, ratio, "joints")
                    yield Coupling(joint, moved_by, ratio, "motors")


def _with_best_ratio(problem: DriveProblem, start: Coupling) -> Coupling:
    """Return a coupling with the ratio of the least error, one of small numbers where that costs little."""
    pair = [start.joint, start.moved_by]

    def coupled(ratio: float) -> Coupling:
        return Coupling(start.joint, start.moved_by, ratio, start.logged_at)

    def cost(ratio: float) -> float:
        errors = held_out_errors(problem.coupled_rows(coupled(ratio)), problem.tau)
        return float(errors[:, pair].mean())

    bounds = sorted((start.ratio / 2, start.ratio * 2))
    best = minimize_scalar(cost, bounds=bounds, method="bounded", options={"xatol": abs(start.ratio) / 100})
    simple = float(Fraction(float(best.x)).limit_denominator(4))
    if simple and cost(simple) <= (1 + TUNING.simple_ratio) * best.fun:
        return coupled(simple)
    return coupled(round(float(best.x), 3))


def _is_sure(logged: np.ndarray, mended: np.ndarray, gain: float, candidates: int) -> bool:
    """Whether errors by block (B,) fell to this part of what they were, and not as the luckiest of some candidates."""
    if mended.min() <= 0 or mended.mean() >= gain * logged.mean():
        return False
    ratios = np.log(logged / mended)  # by factors: a block that is hard to tell counts as any other
    standard_error = ratios.std(ddof=1) / np.sqrt(len(ratios))
    # of hundreds of couplings one is always better by chance (Bonferroni's bound)
    needed = float(student.isf(TUNING.chance / candidates, len(ratios) - 1))
    return bool(ratios.mean() > needed * standard_error)


def _varies(tau: np.ndarray) -> np.ndarray:
    """Whether torques (S, n) are more than a constant with rounding, (n,)."""
    varies: np.ndarray = tau.std(axis=0) > NEGLIGIBLE * np.abs(tau).max(axis=0)
    return varies


def coupling_hint(arm: LoadedArm, coupling: Coupling, remaining: float) -> Diagnostic:
    """Return a coupling that the logs show, in the sidecar's words."""
    names = arm.arm.joint_names
    pair = [coupling.moved_by, coupling.joint]
    matrix = _coupled_inputs(arm.actuation.drives(), coupling)[np.ix_(pair, pair)]
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
    return Diagnostic("warning", "coupled-motors", f"joint {names[coupling.joint]!r}", None, message)


def _coupled_inputs(drives: Drives, coupling: Coupling) -> np.ndarray:
    """Return joint torques by motor torques (n, n) with a coupling beside the known ones."""
    through = np.eye(len(drives.inputs))
    through[coupling.moved_by, coupling.joint] = coupling.ratio
    inputs: np.ndarray = through @ drives.inputs
    return inputs
