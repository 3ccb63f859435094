"""Compare differences between fits of servos to either half of the training motions with their intervals.

    python benchmarks/servo_halves.py ARM.urdf LOGS... [--preset hybrid] [--halvings 5]

The logs go to either half in turn: first in order by name, then in orders drawn at random. For each ratio that both
fits call determined, and the delay, the difference is compared with both half intervals of 95 %, added as squares.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import spelgen

RATIOS = ("kd", "armature", "dry", "static_error", "dead_zone")


def main() -> None:
    """Fit both halves of each halving, and print differences and intervals."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("urdf", type=Path)
    parser.add_argument("logs", type=Path, nargs="+")
    parser.add_argument("--preset", default="hybrid")
    parser.add_argument("--halvings", type=int, default=5)
    options = parser.parse_args()
    inside: list[bool] = []
    for number in range(options.halvings):
        order = np.arange(len(options.logs))
        if number:
            np.random.default_rng(number).shuffle(order)
        logs = [sorted(options.logs)[k] for k in order]
        halves = [fitted_servos(options.urdf, options.preset, logs[half::2]) for half in (0, 1)]
        print(f"{' '.join(x.stem for x in logs[::2])} | {' '.join(x.stem for x in logs[1::2])}")
        inside += compared(*halves)
    share = 100 * sum(inside) / len(inside)
    print(f"{sum(inside)} of {len(inside)} differences lie inside the intervals: {share:.0f} %")


def fitted_servos(urdf: Path, preset: str, logs: Sequence[Path]) -> dict[str, Any]:
    """Fit the model to logs; return the servos of its record."""
    arm = spelgen.load_arm(urdf)
    fit = spelgen.fit(spelgen.build(arm, preset), spelgen.read_logs(logs, arm))
    return dict(fit.record.servo)


def compared(first: dict[str, Any], second: dict[str, Any]) -> Iterator[bool]:
    """Print differences and intervals; yield True for each difference within its interval."""
    delays = [half["delay"] for half in (first, second)]
    difference = delays[0]["value"] - delays[1]["value"]
    yield abs(difference) <= math.hypot(*(delay["half"] for delay in delays))
    print("delay", ", ".join(f"{1000 * d['value']:.1f} +- {1000 * d['half']:.1f} ms" for d in delays))
    for joints in zip(first["joints"], second["joints"], strict=True):
        for ratio in RATIOS:
            intervals = [joint[ratio] for joint in joints if ratio in joint]
            if len(intervals) < 2 or not all(interval["determined"] for interval in intervals):
                continue
            halves = [math.log(interval["high"] / interval["value"]) for interval in intervals]
            difference = math.log(intervals[0]["value"] / intervals[1]["value"])
            yield abs(difference) <= math.hypot(*halves)
            widths = ", ".join(f"{100 * half:.1f}" for half in halves)
            print(f"{joints[0]['joint']:16}{ratio:14}{100 * difference:7.1f} %, half intervals {widths} %")


if __name__ == "__main__":
    main()
