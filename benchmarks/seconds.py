"""Processor time of the commands, divided by the time of `identify --friction memory` in the same run: medians of five.

    python benchmarks/seconds.py [FOLDER] [--repeats 5]

FOLDER is made by `python benchmarks/recordings.py FOLDER`, by default runs/recordings; the
arm is its UR10e, with 100 s of training logs and three test logs.
"""

from __future__ import annotations

import argparse
import resource
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

from recordings import folder_of

TRAINING = ("20_02_10_30sec_12harm", "20_02_12_50sec_12harm", "20_02_05_20sec_8harm")
TESTS = ("19_12_23_free", "20_01_31_unload", "20_02_05_20sec_12harm")
GOALS = {"train closed-form": 2.0, "train hybrid": 4.0, "evaluate": 3.0, "report": 1.0}


def main() -> None:
    """Print the median time of each command, its ratio to `identify`, and the goal of the ratio."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", nargs="?", type=Path)
    parser.add_argument("--repeats", type=int, default=5)
    arguments = parser.parse_args()
    folder = folder_of(arguments.folder) / "ur10e"
    urdf = folder / "ur10e.urdf"
    training, tests = ([folder / f"{name}.parquet" for name in names] for names in (TRAINING, TESTS))
    seconds: dict[str, list[float]] = {name: [] for name in ("identify", *GOALS)}
    with tempfile.TemporaryDirectory() as scratch:
        modules = {preset: Path(scratch) / f"{preset}.py" for preset in ("closed-form", "hybrid")}
        for preset, module in modules.items():
            spelgen("build", urdf, "--preset", preset, "-o", module)
        for repeat in range(arguments.repeats):
            seconds["identify"].append(spelgen("identify", urdf, "--data", *training, "--friction", "memory"))
            for preset, module in modules.items():
                run = Path(scratch) / f"{preset}{repeat}"
                took = spelgen("train", module, "--robot", urdf, "--data", *training, "-o", run)
                seconds[f"train {preset}"].append(took)
            seconds["evaluate"].append(spelgen("evaluate", run, "--data", *tests))
            seconds["report"].append(spelgen("report", run))
    medians = {name: statistics.median(times) for name, times in seconds.items()}
    print(f"{'identify':20}{medians['identify']:7.1f} s")
    for name, goal in GOALS.items():
        ratio = medians[name] / medians["identify"]
        print(f"{name:20}{medians[name]:7.1f} s  {ratio:5.2f} times, goal {goal:g}")


def spelgen(*words: str | Path) -> float:
    """Run a spelgen command in a process; return its processor time [s]."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([sys.executable, "-m", "spelgen", *map(str, words)], check=True, capture_output=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


if __name__ == "__main__":
    main()
