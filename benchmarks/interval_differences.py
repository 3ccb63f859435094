"""Differences between fits to disjoint recordings of an arm, compared with their 95 % intervals.

    python benchmarks/interval_differences.py ARM.urdf LOGS... [--preset hybrid] [--parts 1]
    python benchmarks/interval_differences.py ARM.urdf LOGS... --halvings 10

Each recording, or each of its parts, is fitted separately, and each pair of fits is compared. With --halvings both
halves of the logs are fitted, the logs in order of their names first, then in random orders. For each quantity the
difference of two fits is compared with the root sum of squares of their half intervals, and the share of differences
that are smaller is printed.

Quantities of a fit to torques: base parameters, constants of the drives, and the diagonal of M and the gravity torque
at positions within 30 % of the joints' ranges. Of a fit of servos: the delay, and the ratios to kp that both fits
determine.
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
"""Values and half intervals by quantity, (k,) each; NaN for values that a fit does not determine."""


def main() -> None:
    """Fit groups of recordings, and print per quantity the share of differences between fits within 95 % intervals."""
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
    """Return, for each value that two fits determine, whether the difference is within their combined half interval.

    Args:
        first: values and half intervals of one fit, (k,) each; NaN for values that it does not determine.
        second: likewise, of the other fit.
    """
    difference = np.abs(first[0] - second[0])
    # difference and half intervals may be exactly zero, for a joint that gravity does not load
    inside = difference <= np.hypot(first[1], second[1]) + 1e-12
    return list(inside[np.isfinite(difference)])


def estimates(fit: spelgen.Fit) -> Estimates:
    """Return {quantity: (values, half 95 % intervals)} of a fit, (k,) each.

    A fit to torques has the quantities "base" (base parameters), constants of the drives by name, "M" (its diagonal)
    and "g" (gravity torques), both at `POSITIONS` random positions. A fit of servos has `servo_estimates`.
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
    """Return the delay [s] and the logarithms of `RATIOS` to kp of a fit of servos, with half intervals, by name."""
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
