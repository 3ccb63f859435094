"""Find how much later than positions logs show torques, by least squares on torques moved in time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.optimize import minimize_scalar
from scipy.stats import t as student

from spelgen.dynamics.bristles import reach_of
from spelgen.errors import Diagnostic
from spelgen.identification.friction import FrictionModel
from spelgen.logs.dynamics_samples import DynamicsSamples, dynamics_samples
from spelgen.logs.preprocessing import Preprocessing
from spelgen.logs.trajectory import Trajectory
from spelgen.settings.tuning.identification import DriveHintTuning, IdentificationTuning

HINTS, TUNING = DriveHintTuning(), IdentificationTuning()
SHIFTS = np.array(HINTS.shifts)
FRICTION = FrictionModel(memory=True)

BodyRows = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]
"""Of q, qd, qdd (T, n) the rows (T, n, K) by the bodies' parameters."""


@dataclass(frozen=True)
class TorqueDelay:
    """How much later than positions torques are logged, and half of the 99 % interval [s]; zeros: nothing is sure."""

    delay: float = 0.0
    interval: float = 0.0

    @property
    def notes(self) -> list[Diagnostic]:
        """What a user is told of the delay, if there is one."""
        if not self.delay:
            return []
        message = (
            f"torques are logged {1e3 * abs(self.delay):.2f} +- {1e3 * self.interval:.2f} ms "
            f"{'later' if self.delay > 0 else 'earlier'} than positions; identify and torque fits of rigid "
            f"bodies move them, others with 'train --set torque_delay={self.delay:.4g}'"
        )
        return [Diagnostic("info", "torque-delay", "logs", None, message)]


NO_DELAY = TorqueDelay()


@dataclass(frozen=True)
class _Estimate:
    delay: float
    standard_error: float
    squares: float


def find_torque_delay(
    logs: Sequence[Trajectory],
    kinds: Sequence[str],
    inputs: np.ndarray,
    speeds: np.ndarray,
    body_rows: BodyRows,
    preprocessing: Preprocessing,
) -> TorqueDelay:
    """Return the delay that least squares with and without friction's memory both show, where both fit.

    kinds: the joints' types. inputs: G, (n, n), of logged torques. speeds: C, (n, n), of the drives. The value is that
    of the form of friction that leaves less of the torque.
    """
    reach = replace(
        reach_of(kinds, speeds), smoothing_velocity=np.full(len(kinds), FRICTION.coulomb_smoothing_velocity)
    )
    samples, moved = [], []
    for log in logs[:: -(-len(logs) // HINTS.trajectories)]:
        shifted: list[DynamicsSamples] = []
        for shift in SHIFTS.tolist():
            how = replace(preprocessing, torque_delay=shift)
            shifted += dynamics_samples([log], preprocessing=how, reach=None if shifted else reach)
        if shifted:
            samples.append(shifted[0])
            moved.append(np.stack([x.tau @ inputs.T for x in shifted], axis=2))
    if not samples or not any(x.any() for x in moved):
        return NO_DELAY
    stride = -(-sum(map(len, moved)) // HINTS.samples)
    columns = ("q", "qd", "qdd", "z", "direction")
    q, qd, qdd, z, direction = (
        np.concatenate([getattr(x, name)[::stride] for x in samples]) for name in columns
    )
    tau = np.concatenate([x[::stride] for x in moved])
    bodies = body_rows(q, qd, qdd)
    estimates = []
    # dry friction with and without memory, through the filter of the torques: a delay that only one form shows is its
    # error
    for dry in (z / reach.values, direction[..., None]):
        drives = FRICTION.columns(qd, qdd, dry, speeds)
        estimates.append(_estimate(np.concatenate([bodies, drives], axis=2), tau))
    quantile = student.isf(HINTS.delay_chance / 2, HINTS.blocks - 1)
    # a lag of friction passes for one of torques with memory, not without: its errors are alike to both sides
    memory, direct = estimates
    likely = [direct]
    if memory.squares <= HINTS.unlikely_form * direct.squares:
        likely.append(memory)
    best = min(likely, key=lambda x: x.squares)
    deviations = np.array([x.delay / x.standard_error for x in likely])
    if not ((deviations > quantile).all() or (deviations < -quantile).all()):
        return NO_DELAY
    return TorqueDelay(round(best.delay, 6), float(quantile * best.standard_error))


def _estimate(rows: np.ndarray, tau: np.ndarray) -> _Estimate:
    """Return the delay of the least squares that rows (S, n, K) leave of torques moved by `SHIFTS`, (S, n, D).

    Between shifts a torque is a cubic in the shift: filtered torques are smooth over one step. The standard error is
    that of a jackknife over blocks of time, for what a model misses errs alike for long.
    """
    length = np.sqrt(np.square(rows).sum(axis=(0, 1)))
    rows = rows / np.where(length > 0, length, 1.0)
    deviation = tau.std(axis=(0, 2))
    least = np.maximum(deviation, 1e-3 * deviation.max())
    noise = least
    for _ in range(TUNING.rounds):
        sums = _sums(rows / noise[:, None], tau / noise[:, None])
        total = [x.sum(axis=0) for x in sums]
        delay, parameters = _least(*total)
        left = np.tensordot(rows, parameters, 1) - np.tensordot(tau, _spline(delay), 1)
        noise = np.maximum(left.std(axis=0), TUNING.least_noise * least)
    delays = []
    for block in range(HINTS.blocks):
        delays.append(_least(*(whole - part[block] for whole, part in zip(total, sums, strict=True)))[0])
    spread = np.var(delays) * (HINTS.blocks - 1)
    at_end = abs(delay) > SHIFTS[-2]  # nothing says that it ends there
    standard_error = np.inf if at_end else float(np.sqrt(spread))
    return _Estimate(delay, standard_error, float(np.square(left / least).sum()))


def _sums(rows: np.ndarray, tau: np.ndarray) -> list[np.ndarray]:
    """Return the sums of products of rows with rows, rows with torques and torques with torques, by block of time."""
    products: list[list[np.ndarray]] = [[], [], []]
    for samples in np.array_split(np.arange(len(rows)), HINTS.blocks):
        row = rows[samples].reshape(-1, rows.shape[2])
        torque = tau[samples].reshape(-1, tau.shape[2])
        for kind, product in zip(products, (row.T @ row, row.T @ torque, torque.T @ torque), strict=True):
            kind.append(product)
    return list(map(np.stack, products))


def _least(
    row_squares: np.ndarray, products: np.ndarray, torque_squares: np.ndarray
) -> tuple[float, np.ndarray]:
    """Return the delay of the least squares, and the parameters (K,)."""
    size = TUNING.negligible * np.trace(row_squares)
    parameters = np.linalg.solve(row_squares + size * np.eye(len(row_squares)), products)
    left = torque_squares - products.T @ parameters

    def squares(delay: float) -> float:
        shape = _spline(delay)
        return float(shape @ left @ shape)

    nearest = int(np.argmin(np.diag(left)))
    low, high = SHIFTS[max(nearest - 1, 0)], SHIFTS[min(nearest + 1, len(SHIFTS) - 1)]
    best = minimize_scalar(squares, bounds=(low, high), method="bounded", options={"xatol": 1e-6})
    return float(best.x), parameters @ _spline(best.x)


_cardinal = CubicSpline(SHIFTS, np.eye(len(SHIFTS)))


def _spline(delay: float) -> np.ndarray:
    """Return what of each torque (D,) a torque moved by a delay is."""
    return np.asarray(_cardinal(delay))
