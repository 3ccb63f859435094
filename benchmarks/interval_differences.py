"""Differences between fits to disjoint recordings of an arm, compared with their 95 % intervals.

    python benchmarks/interval_differences.py ARM.urdf LOGS... [--preset hybrid] [--parts 1]
    python benchmarks/interval_differences.py ARM.urdf LOGS... --halvings 10

Each recording is fitted separately, or each of its --parts parts of equal length, and each pair of fits is compared.
With --halvings N, the logs are divided into two halves N times (every second log, in order of their names first, then
in random orders), and the fits to both halves are compared. The two 95 % intervals of a quantity have the half widths
h1 and h2. The share of differences between fits of at most sqrt(h1^2 + h2^2) is printed; it should be 95 %.

Quantities of a fit to torques: base parameters, constants of the drives, and the diagonal of M and the gravity torque
at random positions, at most 30 % of half the range from the centre of each joint's range. Of a fit of servos: the
delay, and kd, armature, dry friction, static error and dead zone relative to kp, if both fits determine them.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator, Sequence
from itertools import combinations, pairwise
from pathlib import Path

import numpy as np

import spelgen
from spelgen.fitting.run_record import Content
from spelgen.identification.intervals import QUANTILE

POSITIONS = 10
# [1] largest distance of positions from the centre of a joint's range, relative to half the range
FRACTION = 0.3
RATIOS = ("kd", "armature", "dry", "static_error", "dead_zone")

Estimates = dict[str, tuple[np.ndarray, np.ndarray]]
"""{quantity: (values, half widths of their 95 % intervals)}, (k,) each; NaN for values without an estimate."""


def main() -> None:
    """Fit sets of recordings; print per quantity the share of differences between two fits within their 95 % interval.

    The interval of a difference has the half width sqrt(h1^2 + h2^2), with the half widths h1 and h2 of both fits.
    """
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("urdf", type=Path)
    parser.add_argument("logs", type=Path, nargs="+")
    parser.add_argument("--preset", default="hybrid")
    parser.add_argument("--parts", type=int, default=1)
    parser.add_argument("--halvings", type=int, default=0)
    options = parser.parse_args()
    arm = spelgen.load_arm(options.urdf)
    logs = spelgen.read_logs(sorted(options.logs), arm)
    inside: dict[str, list[bool]] = {}
    for group in groups(logs, options.parts, options.halvings):
        fits = []
        for recordings in group:
            fits.append(estimates(spelgen.fit(spelgen.build(arm, options.preset), recordings)))
            print("fitted", *(log.name for log in recordings), flush=True)
        for first, second in combinations(fits, 2):
            for name in first:
                inside.setdefault(name, []).extend(agreements(first[name], second[name]))
    shares = {name: 100 * np.mean(found) for name, found in inside.items() if found}
    for name, share in shares.items():
        print(f"{name:14} {share:5.1f} % of {len(inside[name])}")
    print(f"{'mean':14} {np.mean(list(shares.values())):5.1f} %")


def groups(
    logs: Sequence[spelgen.Trajectory], parts: int, halvings: int
) -> Iterator[list[list[spelgen.Trajectory]]]:
    """Yield groups of training sets. Each set is fitted, and the fits of a group are compared in pairs.

    If `halvings` is 0, there is one group, in which each of the `parts` parts of each recording is a set. Otherwise
    each halving of the recordings is a group of two sets.
    """
    if not halvings:
        yield [[part] for part in parts_of(logs, parts)]
    for number in range(halvings):
        order = np.arange(len(logs))
        if number:
            np.random.default_rng(number).shuffle(order)
        yield [[logs[k] for k in order[half::2]] for half in (0, 1)]


def parts_of(logs: Sequence[spelgen.Trajectory], count: int) -> Iterator[spelgen.Trajectory]:
    """Yield each recording in `count` parts of equal length."""
    for log in logs:
        edges = np.linspace(0, len(log), count + 1).astype(int)
        for start, stop in pairwise(edges):
            yield log[start:stop]


def agreements(first: tuple[np.ndarray, np.ndarray], second: tuple[np.ndarray, np.ndarray]) -> list[bool]:
    """Return, for each value that two fits determine, True if |difference| <= sqrt(h1^2 + h2^2).

    Args:
        first: values and half widths h1 of their 95 % intervals, (k,) each, in one fit; NaN for values that this fit
            does not determine.
        second: values and half widths h2 in the other fit.
    """
    difference = np.abs(first[0] - second[0])
    # difference and half intervals may be exactly zero, for a joint that gravity does not load
    inside = difference <= np.hypot(first[1], second[1]) + 1e-12
    return list(inside[np.isfinite(difference)])


def estimates(fit: spelgen.Fit) -> Estimates:
    """Return {quantity: (values, half widths of their 95 % intervals)} of a fit, (k,) each.

    A fit to torques has the quantities "base" (base parameters), constants of the drives by name, "M" (its diagonal)
    and "g" (gravity torques), the last two at `POSITIONS` random positions. For a fit of servos see `servo_estimates`.
    """
    if fit.record.servo is not None:
        return servo_estimates(fit.record.servo)
    posterior, result = fit.posterior, {}
    for name, intervals in {"base": posterior.base_parameters, **posterior.drives}.items():
        result[name] = np.array([x.value for x in intervals]), np.array([x.half for x in intervals])
    joints, draw = posterior.model.spec.joints, np.random.default_rng(0)
    places = FRACTION * draw.uniform(-1.0, 1.0, (POSITIONS, len(joints)))
    q = np.array([joint.center for joint in joints]) + places * [joint.half_range for joint in joints]
    mass, gravity = posterior.mass_matrix(q), posterior.gravity(q)
    diagonal = [np.diagonal(x, axis1=1, axis2=2).ravel() for x in mass]
    result["M"] = diagonal[0], QUANTILE * diagonal[1]
    result["g"] = gravity.value.ravel(), QUANTILE * gravity.std.ravel()
    return result


def servo_estimates(servo: Content) -> Estimates:
    """Return {name: (values, half widths of their 95 % intervals)} of a fit of servos.

    The delay has one value [s]. Each quantity of `RATIOS` has one value per joint, log(quantity / kp); it is NaN if the
    fit does not determine it. servo: results of the fit in its run record.
    """
    delay = servo["delay"]
    result = {"delay": (np.array([delay["value"]]), np.array([delay["half"]]))}
    for ratio in RATIOS:
        rows = []
        for joint in servo["joints"]:
            interval = joint.get(ratio, {"determined": False})
            row = (math.nan, math.nan)
            if interval["determined"]:
                row = math.log(interval["value"]), math.log(interval["high"] / interval["value"])
            rows.append(row)
        values = np.array(rows)
        result[ratio] = values[:, 0], values[:, 1]
    return result


if __name__ == "__main__":
    main()
