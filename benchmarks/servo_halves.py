"""Whether the intervals of a fit of servos say how far two fits differ: to either half of the training motions.

    python benchmarks/servo_halves.py ARM.urdf LOGS... [--preset hybrid]

The logs, in order by name, go to either half in turn. For each ratio that both fits call determined, and the delay, the
difference is compared with both half intervals of 95 %, added as squares.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import spelgen

RATIOS = ("kd", "armature", "dry", "static_error", "dead_zone")


def main() -> None:
    """Fit both halves, and print differences beside intervals."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("urdf", type=Path)
    parser.add_argument("logs", type=Path, nargs="+")
    parser.add_argument("--preset", default="hybrid")
    options = parser.parse_args()
    arm = spelgen.load_arm(options.urdf)
    records = []
    for half in (0, 1):
        logs = spelgen.read_logs(sorted(options.logs)[half::2], arm)
        records.append(spelgen.fit(spelgen.build(arm, options.preset), logs).record["servo"])
    delays = [record["delay"] for record in records]
    inside = [
        abs(delays[0]["value"] - delays[1]["value"]) <= math.hypot(*(delay["half"] for delay in delays))
    ]
    print("delay", ", ".join(f"{1000 * d['value']:.1f} +- {1000 * d['half']:.1f} ms" for d in delays))
    for first, second in zip(*(record["joints"] for record in records), strict=True):
        for ratio in RATIOS:
            intervals = [joint[ratio] for joint in (first, second) if ratio in joint]
            if len(intervals) < 2 or not all(interval["determined"] for interval in intervals):
                continue
            halves = [math.log(interval["high"] / interval["value"]) for interval in intervals]
            difference = math.log(intervals[0]["value"] / intervals[1]["value"])
            inside.append(abs(difference) <= math.hypot(*halves))
            widths = ", ".join(f"{100 * half:.1f}" for half in halves)
            print(f"{first['joint']:16}{ratio:14}{100 * difference:7.1f} %, half intervals {widths} %")
    print(
        f"{sum(inside)} of {len(inside)} differences lie inside the intervals: {100 * sum(inside) / len(inside):.0f} %"
    )


if __name__ == "__main__":
    main()
