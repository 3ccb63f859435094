"""Kill a training at random times and resume it: the final weights equal the weights of an uninterrupted training.

    python benchmarks/kills.py [--kills 50] [--servos]

The training uses AdamW on few windows, and ends at a fixed number of epochs. With --servos, it is a fit of position
servos, which ends by convergence. Each kill is a SIGKILL, which a process cannot catch. It is sent at a random time
after the process has first written to the run folder. `make bench` takes 5 kills.
"""

from __future__ import annotations

import argparse
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from pathlib import Path

import torch

from spelgen.arm.configured_arm import load_arm
from spelgen.emission.specify import generate
from spelgen.fitting.run_folder import RunFolder
from spelgen.logs.read import write_logs
from spelgen.simulation.simulate import simulate

URDF = Path(__file__).parents[1] / "robots" / "rpr.urdf"
ADAMW = ["--set", "optimizer=adamw", "--set", "batch=8", "--set", "momentum_steps=0"]
# [s] A kill is at most this time after the first write of a process. LONGEST: training with AdamW. SHORTER: --servos.
LONGEST, SHORTER = 6.0, 2.0


def main() -> None:
    """Train once without and once with kills, compare the final weights, and exit with 1 if they differ."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kills", type=int, default=5)
    parser.add_argument("--servos", action="store_true", help="a fit of position servos")
    asked = parser.parse_args()
    kills = asked.kills
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        urdf = Path(shutil.copy(URDF, folder))
        settings = "input: position\n" if asked.servos else URDF.with_suffix(".yaml").read_text()
        urdf.with_suffix(".yaml").write_text(settings)
        arm = load_arm(urdf)
        joints = [coordinate.name for coordinate in arm.chain.coordinates]
        write_logs(folder / "train.parquet", simulate(arm, trajectories=4).train, joints)
        source = generate(arm, "closed-form") if asked.servos else generate(arm, "spel", width=4, depth=1)
        (folder / "module.py").write_text(source)
        options = ["--set", "progress=false", "--robot", str(urdf)] + ([] if asked.servos else ADAMW)
        # enough epochs, of about 0.2 s each, that the training does not end before the last kill
        epochs = str(20 + 16 * kills)
        always = [] if asked.servos else ["--set", f"epochs={epochs}", "--set", f"patience={epochs}"]

        def command(run: Path, *, resume: bool) -> list[str]:
            said = ["--resume"] if resume else options
            return [sys.executable, "-m", "spelgen", "train", str(folder / "module.py"), "--data", str(folder), "-o",
                    str(run), *always, *said]  # fmt: skip

        subprocess.run(command(folder / "whole", resume=False), check=True)
        done, draw, run = 0, random.Random(0), folder / "run"
        while True:
            resume = (run / "config.json").exists()
            if not _killed(
                command(run, resume=resume), run, draw.uniform(0, SHORTER if asked.servos else LONGEST)
            ):
                break
            done += done < kills
            if done == kills:
                ready = (run / "config.json").exists()
                subprocess.run(command(run, resume=ready), check=True)
                break
        whole, broken = (RunFolder(x).load_checkpoint() for x in (folder / "whole", run))
        same = all(torch.equal(x, broken.best_weights[key]) for key, x in whole.best_weights.items())
        if not asked.servos:
            same &= all(
                torch.equal(x, broken.content["model"][key]) for key, x in whole.content["model"].items()
            )
        epochs = [len(RunFolder(x).read_metrics()) for x in (folder / "whole", run)]
        print(f"{done} kills, {done} resumes, epochs {epochs}: weights {'identical' if same else 'DIFFER'}")
    if not same or done < kills or len(set(epochs)) > 1:
        sys.exit(1)


def _killed(command: list[str], run: Path, after: float) -> bool:
    """Run a command and kill it `after` seconds after it first wrote to the run folder; False if it ended earlier."""
    before = _writes(run)
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, env=os.environ)
    while process.poll() is None and _writes(run) == before:
        time.sleep(0.01)
    time.sleep(after)
    process.kill()
    return process.wait() != 0


def _writes(run: Path) -> int:
    """Return the sum of the modification times of the run folder's files, which changes with each write."""
    found = 0
    for path in run.glob("[!.]*"):
        with suppress(FileNotFoundError):
            found += path.stat().st_mtime_ns
    return found


if __name__ == "__main__":
    main()
