"""Differences between fits to disjoint recordings of an arm, compared with their 95 % intervals.

    python benchmarks/interval_differences.py ARM.urdf LOGS... [--preset hybrid] [--parts 1]

Each recording, or each of its parts, is fitted separately. For each pair of fits and each quantity (base parameters,
constants of the drives, diagonal of M and gravity torque at positions within 30 % of the joints' ranges), the
difference is compared with both half intervals, added as squares. Printed is the share of differences inside, per
quantity.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from itertools import combinations, pairwise
from pathlib import Path

import numpy as np

import spelgen
from spelgen.identification.intervals import QUANTILE

POSITIONS = 10
FRACTION = 0.3  # of half a joint's range


def main() -> None:
    """Fit all recordings, and print the shares of the differences that lie inside the intervals."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("urdf", type=Path)
    parser.add_argument("logs", type=Path, nargs="+")
    parser.add_argument("--preset", default="hybrid")
    parser.add_argument("--parts", type=int, default=1)
    options = parser.parse_args()
    arm, fits = spelgen.load_arm(options.urdf), []
    for part in parts_of(spelgen.read_logs(options.logs, arm), options.parts):
        fits.append(estimates(spelgen.fit(spelgen.build(arm, options.preset), [part]).posterior))
        print(f"fitted {part.name}: {len(part)} samples", flush=True)
    shares = {}
    for name in fits[0]:
        inside = []
        for one, other in combinations(fits, 2):
            (first, first_std), (second, second_std) = one[name], other[name]
            bound = QUANTILE * np.hypot(first_std, second_std)
            # both may be exactly zero: a joint that gravity does not load
            inside.append(np.abs(first - second) <= bound + 1e-12)
        shares[name] = np.mean(inside)
        print(f"{name:10} {100 * shares[name]:5.1f} %")
    print(f"{'mean':10} {100 * np.mean(list(shares.values())):5.1f} %")


def parts_of(logs: list[spelgen.Trajectory], count: int) -> Iterator[spelgen.Trajectory]:
    """Yield each recording in `count` parts of equal length."""
    for log in logs:
        edges = np.linspace(0, len(log), count + 1).astype(int)
        for start, stop in pairwise(edges):
            yield log[start:stop]


def estimates(posterior: spelgen.Posterior) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return values and standard deviations, (k,) each, by quantity."""
    groups = {"base": posterior.base_parameters, **posterior.drives}
    result = {}
    for name, intervals in groups.items():
        result[name] = np.array([x.value for x in intervals]), np.array([x.std for x in intervals])
    joints, draw = posterior.model.spec.joints, np.random.default_rng(0)
    places = FRACTION * draw.uniform(-1.0, 1.0, (POSITIONS, len(joints)))
    q = np.array([joint.center for joint in joints]) + places * [joint.half_range for joint in joints]
    mass, gravity = posterior.mass_matrix(q), posterior.gravity(q)
    diagonal = [np.diagonal(x, axis1=1, axis2=2).ravel() for x in mass]
    result["M"] = diagonal[0], diagonal[1]
    result["g"] = gravity.value.ravel(), gravity.std.ravel()
    return result


if __name__ == "__main__":
    main()
