"""Checks of units, signs and columns, by a comparison of positions with the integrals of velocities.

If positions and velocities contradict each other, a check searches for units, a sign or other columns with which they
agree, and advises the corresponding settings.
"""

from collections.abc import Iterator
from dataclasses import replace
from itertools import product
from math import log
from typing import Any

import numpy as np

from spelgen.logs.joint_signals import Advice, JointSignals, is_factor, plain_number
from spelgen.logs.jumps import held_samples
from spelgen.logs.trajectory import Trajectory, split_at_gaps
from spelgen.logs.tuning import SIGNALS, TUNING, shows_accelerations
from spelgen.settings.log_mapping import SCALES, TIMES

TURNS = 4 * np.pi  # [rad] largest range of a joint with limits; a q with a larger range is not in rad
LONGEST = 30.0  # [m] largest range of a prismatic joint; a q with a larger range is not in m
# Units of positions and of velocities that loggers use, per joint type. The SI unit is first.
UNITS = {
    "revolute": (("rad", "deg", "turns", "mrad"), ("rad/s", "deg/s", "rpm", "turns/s", "mrad/s")),
    "prismatic": (("m", "mm"), ("m/s", "mm/s")),
}


def velocity_products(trajectory: Trajectory) -> np.ndarray:
    """Return the Gram matrix (2n, 2n) of 2n signals: n integrals of qd, then n positions q.

    An element is the scalar product of the increments of two signals; an increment is the change over ten samples. The
    matrix shows whether qd is the derivative of q, see `velocity_agreement`.
    """
    # SciPy is imported within the function, since its import takes half a second.
    from scipy.integrate import cumulative_trapezoid

    products = np.zeros((2 * trajectory.q.shape[1],) * 2)
    for piece in split_at_gaps(trajectory, shortest=2):
        # Increments over several samples are used, because between neighbouring samples the quantisation step may be
        # larger than the change of q.
        span = min(SIGNALS.increments, len(piece) - 1)
        integral = cumulative_trapezoid(piece.qd, piece.t, axis=0, initial=0)
        positions = np.concatenate([integral, piece.q], axis=1)
        increments = positions[span:] - positions[:-span]
        products += increments.T @ increments
    return products


def velocity_agreement(products: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return factors (n,) and correlations (n, n) between velocities qd and derivatives of positions dq/dt.

    The factor c of a joint is the least-squares solution of dq/dt = c qd. Correlation (i, j) is between qd of joint i
    and dq/dt of joint j; it is NaN if joint i or joint j is at rest. products: (2n, 2n), see `velocity_products`.
    """
    n = len(products) // 2
    qd_squares, q_squares = np.split(products.diagonal(), 2)
    sizes = np.outer(np.sqrt(qd_squares), np.sqrt(q_squares))
    correlations = products[:n, n:] / np.where(sizes > 1e-12, sizes, np.nan)
    return products[:n, n:].diagonal() / np.where(qd_squares > 0, qd_squares, np.nan), correlations


def find_units(signals: JointSignals) -> str | Advice | None:
    """Return a finding if q or qd has a wrong unit: q has too large a range, or dq/dt is a multiple of qd.

    The largest range is two turns, or 30 m for prismatic joints. The finding is `Advice` with the settings that
    correct it; if they are unknown, only a message. None: no fault.
    """
    mapping, joint = signals.trajectory.mapping, signals.joint
    # If the median time step exceeds 0.5 s, the times are not in seconds, and dq/dt is wrong: see `find_time_unit`.
    if signals.step > SIGNALS.slowest_step:
        return None
    limit, range_text, key = TURNS, "two turns", "counts_per_turn"
    if signals.kind == "prismatic":
        limit, range_text, key = LONGEST, f"{LONGEST:g} m", "counts_per_metre"
    is_far = np.ptp(signals.q) > limit and not signals.turns and mapping.unit("q", joint) is None
    message = f"q that changes {signals.factor:.3g} times as fast as qd"
    if is_far:
        message = f"q from {signals.q.min():.3g} to {signals.q.max():.3g}, more than {range_text}"
        if signals.is_whole:
            message += f" (whole numbers: counts of an encoder need '{key}')"
            # Whole numbers may be counts of an encoder or degrees. Without velocities this is unknown: no unit is
            # advised.
            if not _knows_ratio(signals):
                return message
    # `distance`: implausibility of a combination of units. Of combinations whose distances differ by rounding only, the
    # first is used, since its units are most frequent.
    readings = _unit_readings(signals, is_far)
    distance, keys = min(readings, key=lambda reading: round(reading[0], 3), default=(np.inf, {}))
    registers = signals.qd / mapping.scale("qd", joint)
    is_register = bool((registers == registers.round()).all())
    # If dq/dt is the same multiple of qd at all joints, and no combination of units explains this multiple within a few
    # per cent, the times are wrong and not the units: `find_time_unit` reports this fault. Example: times in units of
    # 0.1 us that are read as us give the multiple 0.1, which differs from the 0.105 of velocities in rpm. An exception
    # are velocities that are whole numbers: they may be values of registers, in any unit.
    is_other = bool(keys) and not is_far and distance > 0.03 + 0.02 * len(keys["units"])
    if is_other and not is_register and _rate_by_velocities(signals):
        return None
    if distance > log(1.25):
        if is_far or not is_register:
            return message if is_far else None
        message += ", whole numbers of an unknown unit, such as register values"
        return Advice(message, keys={"velocity": "differentiated"})
    units = " and ".join(f"{name} in {unit}" for name, unit in keys.get("units", {}).items())
    # The unit advised for q also applies to commands. But if the range of the commands is less than a third of the
    # range of q, the commands are already in SI units, and the SI unit is advised for the commands.
    if keys and signals.trajectory.u is not None and np.ptp(signals.signal("u")) < np.ptp(signals.q) / 3:
        keys = keys | {"units": keys["units"] | {"u": "m" if signals.kind == "prismatic" else "rad"}}
    # Positions beyond two turns may be in degrees, or be measured at a motor before a gear. Only a ratio of dq/dt to qd
    # that differs from 1 shows which is true; without it the unit is a guess.
    is_guess = is_far and not (_knows_ratio(signals) and abs(signals.factor) > 1.25)
    of_log = {"velocity": "differentiated"} if "sign" in keys else {}
    return Advice(f"{message}: {units}", keys, of_log, is_guess) if keys else None


def _knows_ratio(signals: JointSignals) -> bool:
    """Return True if velocities qd were logged and are proportional to dq/dt: the ratio qd : dq/dt then shows units."""
    is_known = abs(signals.correlation) > SIGNALS.agreement and len(signals.q) > SIGNALS.increments + 1
    return is_known and "qd" in signals.trajectory.mapping.quantities


def _unit_readings(signals: JointSignals, is_far: bool) -> Iterator[tuple[float, dict[str, Any]]]:
    """Yield (distance, settings of the joint) for all units of q and qd that the column mapping permits.

    The smaller the distance, the more plausible are the settings. The distance is |log r|, with r the ratio of dq/dt to
    qd in these units, plus a penalty for units other than SI.

    is_far: True if q has no stated unit, and its range is too large for rad or m (see `find_units`). Units in which |q|
    exceeds two turns, or 12.6 m, are then omitted.
    """
    mapping, joint = signals.trajectory.mapping, signals.joint
    # The ratio r of dq/dt to qd is known only if velocities were logged and are proportional to dq/dt. If it is
    # unknown, only the range of q indicates a unit.
    is_known = _knows_ratio(signals)
    positions, speeds = UNITS["prismatic" if signals.kind == "prismatic" else "revolute"]
    stated = mapping.unit("q", joint)
    # If all joints move by less than 0.1 rad or m, the unit of positions in the mapping may be wrong, such as deg for
    # positions in rad. Other units of positions are then preferred to other units of velocities.
    largest = float(np.ptp(signals.trajectory.q, axis=0).max())
    # Units of positions in which no joint would move by 0.05 rad or m are not tested. If only such a unit explains the
    # ratio of dq/dt to qd, a wrong unit of times is more likely.
    smallest = 0.05 / largest if is_known and largest > 0 else 0.0
    for unit in positions if stated and is_known and largest < 0.1 else ():
        ratio = SCALES.get(unit, 1.0) / SCALES.get(stated or unit, 1.0)
        if 0.5 < largest * ratio < TURNS:
            yield abs(log(abs(signals.factor) * ratio)) + 0.01, {"units": {"q": unit}}
    if stated:
        positions = positions[:1]
    elif is_far and (signals.is_whole or not is_known):
        positions = positions[:3]  # mrad is omitted: encoder counts have similar ranges
    if not is_known or mapping.unit("qd", joint):
        speeds = speeds[:1]
    for q, qd in product(positions, speeds):
        scale = SCALES.get(q, 1.0)
        if scale < min(smallest, 1.0):
            continue
        units = {name: x for name, x in (("q", q), ("qd", qd)) if x in SCALES}
        distance = abs(log(abs(signals.factor) * scale / SCALES.get(qd, 1.0))) if is_known else 0.0
        if not is_far or np.abs(signals.q).max() * scale <= TURNS:
            yield distance + 0.02 * len(units), {"units": units} if units else {}
    gear = abs(signals.factor)
    if is_far and is_known and not signals.is_whole and np.abs(signals.q).max() < TURNS * gear:
        # If q is measured at the motor of a gear, the ratio of dq/dt to qd is the gear ratio, which may be any number.
        # The better dq/dt and qd are correlated, the more exact is the measured ratio. The distance (implausibility) of
        # this explanation therefore decreases with the correlation.
        keys = {"units": {"q": "counts"}, "counts_per_turn": plain_number(2 * np.pi * gear)}
        if signals.factor < 0:
            # dq/dt and qd have opposite signs, so q is reversed by the setting `sign`. This setting also reverses the
            # torque, which is assumed to have the sense of qd already. A negative gain undoes this.
            keys |= {"sign": -mapping.joint(joint).sign, "gain": -(mapping.joint(joint).gain or 1.0)}
        yield 0.05 + 1 - signals.correlation**2, keys
    is_encoder = is_known and "turns" in positions and (signals.is_whole or not is_far)
    for counts in (2 ** np.arange(10, 21)).tolist() if is_encoder else ():
        if 2 * np.pi / counts >= smallest:
            distance = abs(log(abs(signals.factor) * 2 * np.pi / counts)) + 0.02
            yield distance, {"units": {"q": "counts"}, "counts_per_turn": counts}


def find_time_unit(signals: JointSignals) -> str | Advice | None:
    """Return a finding if times are not in seconds.

    The sample rate is then below 2 Hz, or dq/dt is a power of 1000 times qd, or dq/dt is the same multiple of qd at all
    joints.
    """
    step, is_stated = signals.step, signals.trajectory.mapping.units.t != "s"
    rate = _rate_by_velocities(signals)
    if rate:
        message = (
            f"q that changes {signals.factor:.3g} times as fast as qd: the rate is {rate:g} Hz, not {1 / step:.3g} Hz "
            "(if the times are right, the velocities are in another unit: 'velocity: differentiated' uses those of q)"
        )
        return Advice(message, keys={"sample_rate": rate})
    message, unit = f"a sample every {step:.3g} s", time_unit(step)
    if 0 < step < SIGNALS.fastest_step / 2 and not signals.number:
        return f"{message}, faster than any arm is sampled: write 'sample_rate', or times in s"
    if step <= SIGNALS.slowest_step:
        message = f"q that changes {signals.factor:.3g} times as fast as qd"
        is_known = signals.correlation > SIGNALS.agreement
        unit = next((x for x in TIMES if x != "s" and is_known and is_factor(signals.factor, TIMES[x])), None)
    elif signals.number:
        # A wrong unit of times is a fault of all joints, which is reported only once, for joint 0.
        return None
    elif unit is not None:
        message += f", {1 / (step * TIMES[unit]):.4g} Hz if times are in {unit}"
    if unit is None or is_stated:
        return message if step > SIGNALS.slowest_step else None
    return Advice(message, keys={"units": {"t": unit}})


def _rate_by_velocities(signals: JointSignals) -> float | None:
    """Return the sample rate [Hz] at which dq/dt would be equal to qd at all joints, for logs with wrong times.

    None is returned if the times may be right. None is also returned if the ratio of dq/dt to qd is the ratio of two
    units of time, such as 1000: the caller then advises the unit of the times instead of a sample rate.
    """
    factors = signals.factors[~np.isnan(signals.factors)]
    mapping, steps = signals.trajectory.mapping, np.diff(signals.trajectory.t)
    if "qd" not in mapping.quantities or len(factors) < 2 or len(steps) <= 2 * SIGNALS.increments:
        return None
    factor = float(np.median(factors))
    # The times are assumed to be wrong only if dq/dt is the same multiple of qd for all joints, and time steps are
    # equal.
    is_common = factor > 0 and np.ptp(factors) < 0.05 * factor and signals.correlation > 0.98
    if not is_common or abs(steps - signals.step).max() > 0.5 * signals.step:
        return None
    # If the ratio of dq/dt to qd is between 1/1.5 and 1.5, wrong velocities are more probable than wrong times. If it
    # is a factor between two units of time, such as 1000, the caller reports the unit.
    if abs(log(factor)) < log(1.5) or any(is_factor(factor, TIMES[unit]) for unit in TIMES):
        return None
    step = signals.step * factor
    return plain_number(1 / step, 4) if SIGNALS.fastest_step <= step <= SIGNALS.slowest_step else None


def time_unit(step: float) -> str | None:
    """Return the unit of time in which a step of a robot's log is plausible (0.1 ms to 0.5 s); None without one."""
    # Several units of time may be plausible, since they differ by factors of 1000, and the plausible steps range over a
    # factor of 5000. The largest plausible unit is returned.
    slowest, fastest = SIGNALS.slowest_step, SIGNALS.fastest_step
    return next((unit for unit, size in TIMES.items() if fastest <= step * size <= slowest), None)


def find_wrong_velocity(signals: JointSignals) -> str | Advice | None:
    """Return a finding if qd is not dq/dt, with advice if another sign or other columns correct it."""
    factor, correlation, tolerance = signals.factor, signals.correlation, 1 - SIGNALS.agreement
    # If the median time step exceeds 0.5 s, the times are not in seconds, and dq/dt is wrong: see `find_time_unit`.
    if signals.step > SIGNALS.slowest_step or "qd" not in signals.trajectory.mapping.quantities:
        return None
    if np.isnan(correlation) or signals.is_at_rest or _is_below_resolution(signals):
        return None
    # The factor is as exact as the correlation is high: noise and filters lower both.
    if correlation >= SIGNALS.agreement and abs(factor - 1) <= min(tolerance, 0.03 + 2 * (1 - correlation)):
        lag = _velocity_lag(signals)
        if abs(lag) < SIGNALS.longest_lag:
            text = _velocity_sum(signals) if correlation < 0.99 else ""
            return f"qd is not dq/dt{text}" if text else None
        order = "later" if lag > 0 else "earlier"
        message = f"qd that is {1e3 * abs(lag):.3g} ms {order} than dq/dt"
        return Advice(message, keys={"velocity": "differentiated"})
    message = f"qd is not dq/dt: the best factor is {factor:.3g}, the correlation {correlation:.3g}"
    if len(signals.q) <= SIGNALS.increments + 1:
        # The correlation is computed from changes over ten samples. In a log of at most 11 samples it is computed from
        # a single change, so that it is always 1 or -1 and does not justify advice.
        return message
    if abs(factor + 1) <= tolerance and correlation < -SIGNALS.agreement:
        # If only the sign of qd is wrong, q is correct, and its derivative can replace qd.
        return Advice(f"{message}; its sense is opposite", keys={"velocity": "differentiated"})
    trajectory, mapping, k = signals.trajectory, signals.trajectory.mapping, signals.number
    # In synchronous motion, the velocity columns of all joints are correlated with dq/dt of this joint. The right
    # column also has the right magnitude: its squared difference from dq/dt is smallest.
    products, n = velocity_products(trajectory), len(signals.joints)
    squares, scalar_products = products.diagonal()[:n], products[:n, n + k]
    nearest = int((squares - 2 * scalar_products).argmin())
    is_right = abs(scalar_products[nearest] - squares[nearest]) <= tolerance * squares[nearest]
    if nearest != k and is_right and signals.correlations[nearest] >= SIGNALS.agreement:
        columns = {"qd": mapping.column("qd", signals.joints[nearest])}
        return Advice(f"{message}; that of joint {signals.joints[nearest]!r} is", {"columns": columns})
    exchanged = velocity_products(replace(trajectory, q=trajectory.qd, qd=trajectory.q))
    factors, correlations = velocity_agreement(exchanged)
    if correlations[k, k] > SIGNALS.agreement and abs(factors[k] - 1) < 0.5:
        columns = {"q": mapping.column("qd", signals.joint), "qd": mapping.column("q", signals.joint)}
        return Advice(f"{message}; q is the derivative of qd", {"columns": columns})
    return message + _velocity_sum(signals)


def _is_below_resolution(signals: JointSignals) -> bool:
    """Return True if the RMS of dq/dt is below the smallest change of qd, so that dq/dt and qd cannot be compared.

    An example is a joint that the controller holds, whose position varies by a few steps of its encoder.
    """
    t, qd = signals.trajectory.t, signals.trajectory.qd[:, signals.number]
    span = min(SIGNALS.increments, len(t) - 1)
    changes = np.abs(np.diff(qd))
    velocity = (signals.q[span:] - signals.q[:-span]) / (t[span:] - t[:-span])
    return bool(changes.any() and np.sqrt(np.square(velocity).mean()) < changes[changes > 0].min())


def _velocity_sum(signals: JointSignals) -> str:
    """Return a text if the joint's qd is a sum or difference of dq/dt of several joints (coupled wrist), else ""."""
    products = velocity_products(signals.trajectory)
    n, power = len(signals.joints), products[signals.number, signals.number]
    gram, target = products[n:, n:], products[n:, signals.number]
    # In a wrist with a differential gear, the velocity of a motor is a sum or difference of joint velocities, with
    # coefficients -1, -1/2, 1/2 or 1. `factors` are therefore rounded to multiples of 1/2.
    factors = np.round(2 * np.linalg.lstsq(gram, target, rcond=1e-9)[0]) / 2
    terms = np.flatnonzero(factors).tolist()
    residual = power - 2 * factors @ target + factors @ gram @ factors
    if len(terms) < 2 or np.abs(factors).max() > 1 or residual > (1 - SIGNALS.agreement) ** 2 * power:
        return ""
    texts = [f"{factors[k]:+g} dq/dt of joint {signals.joints[k]!r}".replace("1 dq", " dq") for k in terms]
    formula = " ".join(texts).removeprefix("+").strip()
    return f"; it is {formula}: one of both is that of the motors of a coupled wrist; log both at the joints"


def _velocity_lag(signals: JointSignals) -> float:
    """Return the least-squares delay [s] of the joint's qd relative to dq/dt; 0 if the log does not determine it.

    The difference between q and the integral of a delayed qd is the delay times qd, plus a slow drift, plus a multiple
    of q if the scale of qd is somewhat wrong.
    """
    from scipy.integrate import cumulative_trapezoid

    if signals.trajectory.mapping.velocity == "differentiated":
        return 0.0
    piece = max(split_at_gaps(signals.trajectory), key=len)
    t, q, qd = piece.t, piece.q[:, signals.number], piece.qd[:, signals.number]
    if len(t) < 100:
        return 0.0
    drift = np.stack([np.ones_like(t), t, t**2, q], axis=1)
    columns = np.stack([qd, q - cumulative_trapezoid(qd, t, initial=0)], axis=1)
    speed, difference = (columns - drift @ np.linalg.lstsq(drift, columns, rcond=None)[0]).T
    power = float(speed @ speed)
    lag = float(speed @ difference) / power if power else 0.0
    residual = difference - lag * speed
    # The delay must explain 75 % of the squared difference between q and the integral of qd. An apparent delay that is
    # due to noise explains much less.
    return lag if residual @ residual < 0.25 * difference @ difference else 0.0


def find_copied(signals: JointSignals) -> str | None:
    """Return a message if the joint's torque is a copy: proportional to another joint's torque, without noise."""
    trajectory, k = signals.trajectory, signals.number
    if not trajectory.tau.size or np.ptp(trajectory.tau[:, k]) == 0 or len(signals.q) < TUNING.jump_window:
        return None
    centred = trajectory.tau - trajectory.tau.mean(axis=0)
    lengths = np.linalg.norm(centred, axis=0)
    correlations = np.abs(centred[:, k] @ centred) / np.where(lengths > 0, lengths[k] * lengths, np.inf)
    correlations[k] = 0.0
    # The torques of two sensors are never correlated this closely: even noise of 18-bit sensors lowers the correlation
    # by 1e-11.
    copies = np.flatnonzero(correlations > 1 - 1e-12)
    if not copies.size:
        return None
    other = signals.joints[copies[0]]
    return f"tau that is proportional to the torque of joint {other!r}, without noise: one column is a copy"


def find_held(signals: JointSignals) -> str | None:
    """Return a message if the logger repeats each value of a measured signal of the joint in several rows."""
    rate = signals.trajectory.sample_rate
    for name in signals.measured:
        often = held_samples(signals.signal(name))
        if often > 1:
            rates = f"{rate / often:.3g} times a second in rows at {rate:.4g} Hz"
            return f"{name} that changes {rates}: each value lasts {often} samples"
    return None


def find_too_rare(signals: JointSignals) -> str | Advice | None:
    """Return a finding if a signal changes too rarely for the computation of accelerations: below 24 Hz.

    Return None for logs of position commands, whose fits do not need accelerations.
    """
    rate = signals.trajectory.sample_rate
    if signals.trajectory.u is not None or not shows_accelerations(rate):
        return None
    repeated = {name: held_samples(signals.signal(name)) for name in signals.measured}
    message = find_held(signals)
    if message is None or shows_accelerations(rate / max(repeated.values())):
        return None
    # If only values of qd are repeated, the advice is to compute velocities from the positions.
    is_mended = all(often == 1 for name, often in repeated.items() if name != "qd")
    return Advice(message, keys={"velocity": "differentiated"}) if is_mended else message


def is_one_sided(values: np.ndarray, share: float = 0.05) -> np.ndarray:
    """Return a mask (...) of the signals `values` (T, ...) that are nearly always positive or nearly always negative.

    share: a signal is nearly always positive if its smallest value is at least -share times its largest value, and
    nearly always negative if this is true of -signal.
    """
    below, above = np.maximum(-values.min(axis=0), 0.0), np.maximum(values.max(axis=0), 0.0)
    return np.asarray(np.minimum(below, above) <= share * np.maximum(below, above))


def find_unsigned_velocity(signals: JointSignals) -> str | None:
    """Return a message if the velocities of the joint have no sign: qd is |dq/dt|."""
    trajectory, qd, share = signals.trajectory, signals.qd, 0.05
    # Only logged velocities that are nearly all of one sign are tested. Velocities computed from positions have a sign.
    if "qd" not in trajectory.mapping.quantities or not is_one_sided(qd, share) or len(qd) < 3:
        return None
    speed = np.gradient(signals.q, trajectory.t)
    backward, forward = sorted((-np.quantile(speed, 0.02), np.quantile(speed, 0.98)))
    if backward < share * forward or abs(qd).std() == 0:
        return None
    if not np.corrcoef(np.abs(speed), np.abs(qd))[0, 1] > 0.9:
        return None
    # Quantised positions make dq/dt negative for single samples. The magnitudes must agree far better than the values.
    if np.sum((np.abs(speed) - np.abs(qd)) ** 2) > 0.5 * np.sum((speed - qd) ** 2):
        return None
    return f"qd that is the magnitude of dq/dt: from {qd.min():.3g} to {qd.max():.3g} while q goes both ways"
