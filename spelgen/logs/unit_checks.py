"""Compare positions with the integrals of velocities: units, senses and columns that explain a mismatch.

A finding with a line advises a reading of the columns under which positions and velocities agree.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import product
from math import log
from typing import NamedTuple

import numpy as np

from spelgen.logs.joint_signals import Advice, JointSignals
from spelgen.logs.trajectory import Trajectory, split_at_gaps
from spelgen.logs.tuning import SIGNALS
from spelgen.settings.log_mapping import SCALES, TIMES

TURNS = 4 * np.pi  # [rad] A joint with limits turns less: larger positions are in another unit.
# units of loggers; SI units, which need no line, come first
UNITS = {
    "revolute": (("rad", "deg", "turns", "mrad"), ("rad/s", "deg/s", "rpm", "turns/s", "mrad/s")),
    "prismatic": (("m", "mm"), ("m/s", "mm/s")),
}


def velocity_products(trajectory: Trajectory) -> np.ndarray:
    """Return sums of products (2n, 2n) of increments over several samples: of the integrals of qd, then of q."""
    # imported here, since it takes half a second
    from scipy.integrate import cumulative_trapezoid

    products = np.zeros((2 * trajectory.q.shape[1],) * 2)
    for piece in split_at_gaps(trajectory, shortest=2):
        # over several samples: between neighbouring samples the quantisation of q may be larger than its change
        span = min(SIGNALS.increments, len(piece) - 1)
        integral = cumulative_trapezoid(piece.qd, piece.t, axis=0, initial=0)
        positions = np.concatenate([integral, piece.q], axis=1)
        increments = positions[span:] - positions[:-span]
        products += increments.T @ increments
    return products


def velocity_agreement(products: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return factors (n,) by which qd must be multiplied to be dq/dt, and correlations (n, n).

    Correlation (i, j) is 1 if qd of joint i is proportional to dq/dt of joint j, and NaN if one of them is at rest.
    products: see `velocity_products`.
    """
    n = len(products) // 2
    qd_squares, q_squares = np.split(products.diagonal(), 2)
    sizes = np.outer(np.sqrt(qd_squares), np.sqrt(q_squares))
    correlations = products[:n, n:] / np.where(sizes > 1e-12, sizes, np.nan)
    return products[:n, n:].diagonal() / np.where(qd_squares > 0, qd_squares, np.nan), correlations


class UnitReading(NamedTuple):
    """Reading of q and qd of a joint in other units.

    units: by quantity, empty for the unchanged joint. distance: of the ratio of dq/dt to qd from 1, plus a penalty for
    each other unit. counts: per revolution, if q is in counts.
    """

    units: dict[str, str]
    distance: float
    counts: int = 0


def find_units(signals: JointSignals) -> str | Advice | None:
    """Find other units than the mapping states: q is more than two turns, or a multiple of the integral of qd."""
    if signals.step > SIGNALS.slowest_step:
        return None  # the times are in another unit
    is_stated = signals.turns or signals.trajectory.mapping.unit("q", signals.joint) is not None
    is_far = np.ptp(signals.q) > TURNS and not is_stated and signals.kind != "prismatic"
    message = f"q that changes {signals.factor:.3g} times as fast as qd"
    if is_far:
        message = f"q from {signals.q.min():.3g} to {signals.q.max():.3g}, more than two turns"
    best = min(_unit_readings(signals, is_far), key=lambda x: x.distance, default=None)
    if best is None or best.distance > log(SIGNALS.unit_factor):
        return message if is_far else None
    if not best.units:
        return None
    keys: dict[str, object] = {"units": best.units}
    if best.counts:
        keys["counts_per_turn"] = best.counts
    units = " and ".join(f"{name} in {unit}" for name, unit in best.units.items())
    return Advice(f"{message}: {units}", {"joints": {signals.joint: keys}})


def _unit_readings(signals: JointSignals, is_far: bool) -> Iterator[UnitReading]:
    """Yield the readings of a joint in units that its mapping does not state. is_far: q is more than two turns."""
    mapping, span = signals.trajectory.mapping, float(np.ptp(signals.q))
    # without velocities only the range shows a unit
    is_known = signals.correlation > SIGNALS.agreement and len(signals.q) > SIGNALS.increments
    is_known &= "qd" in mapping.quantities
    positions, speeds = UNITS["prismatic" if signals.kind == "prismatic" else "revolute"]
    if mapping.unit("q", signals.joint):
        positions = positions[:1]
    if not is_known or mapping.unit("qd", signals.joint):
        speeds = speeds[:1]
    for q, qd in product(positions, speeds):
        scale = SCALES.get(q, 1.0)
        if is_far and span * scale > TURNS:
            continue
        units = {} if q == positions[0] else {"q": q}
        if qd != speeds[0]:
            units["qd"] = qd
        distance = abs(log(signals.factor * scale / SCALES.get(qd, 1.0))) if is_known else 0.0
        yield UnitReading(units, distance + SIGNALS.rare_unit * len(units))
    for counts in 2 ** np.arange(10, 21) if is_known and "turns" in positions else ():
        distance = abs(log(signals.factor * 2 * np.pi / counts))
        yield UnitReading({"q": "counts"}, distance + SIGNALS.rare_unit, int(counts))


def find_time_unit(signals: JointSignals) -> str | Advice | None:
    """Find times that are not in seconds: from a sample rate below 2 Hz, or from the ratio of dq/dt to qd."""
    step, is_stated = signals.step, signals.trajectory.mapping.units.t != "s"
    message, unit = f"a sample every {step:.3g} s", time_unit(step)
    if step <= SIGNALS.slowest_step:
        message = f"q that changes {signals.factor:.3g} times as fast as qd"
        unit = next((x for x in TIMES if x != "s" and signals.changes_by(TIMES[x])), None)
    elif signals.number:
        return None  # reported once, and not for each joint
    elif unit is not None:
        message += f", {1 / (step * TIMES[unit]):.4g} Hz if times are in {unit}"
    if unit is None or is_stated:
        return message if step > SIGNALS.slowest_step else None
    return Advice(message, {"units": {"t": unit}})


def time_unit(step: float) -> str | None:
    """Return the unit of time in which a step between samples is plausible for a robot's log; None if there is none."""
    for unit, size in TIMES.items():
        if SIGNALS.fastest_step <= step * size <= SIGNALS.slowest_step:
            return unit
    return None


def find_wrong_velocity(signals: JointSignals) -> str | Advice | None:
    """Find velocities that are not the derivative of the positions, and the columns or the sense that fit better."""
    factor, correlation, tolerance = signals.factor, signals.correlation, 1 - SIGNALS.agreement
    # times in another unit are a finding of the first joint already
    if signals.step > SIGNALS.slowest_step:
        return None
    if np.isnan(correlation) or (correlation >= SIGNALS.agreement and abs(factor - 1) <= tolerance):
        return None
    message = f"qd is not dq/dt: the best factor is {factor:.3g}, the correlation {correlation:.3g}"
    if len(signals.q) <= SIGNALS.increments:
        return message  # of two samples every correlation is 1
    if abs(factor + 1) <= tolerance and correlation < -SIGNALS.agreement:
        # the velocity is correct except for its sign, so q is correct, and its derivative can replace qd
        return Advice(f"{message}; its sense is opposite", {"velocity": "differentiated"})
    trajectory, joint, mapping = signals.trajectory, signals.joint, signals.trajectory.mapping
    for other, fit in zip(signals.joints, signals.correlations, strict=True):
        if fit > max(SIGNALS.agreement, correlation):
            columns = {"qd": mapping.column("qd", other)}
            message += f"; that of joint {other!r} is"
            return Advice(message, {"joints": {joint: {"columns": columns}}})
    exchanged = velocity_products(replace(trajectory, q=trajectory.qd, qd=trajectory.q))
    factors, correlations = velocity_agreement(exchanged)
    if (
        correlations[signals.number, signals.number] > SIGNALS.agreement
        and abs(factors[signals.number] - 1) < 0.5
    ):
        columns = {"q": mapping.column("qd", joint), "qd": mapping.column("q", joint)}
        return Advice(f"{message}; q is the derivative of qd", {"joints": {joint: {"columns": columns}}})
    return message
