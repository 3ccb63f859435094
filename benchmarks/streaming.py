"""Fits a log larger than memory: how much memory that takes, and how long.

    python benchmarks/streaming.py [--gigabytes 5] [--preset closed-form]

It is fitted to torques, as all logs larger than memory are.

The log is synthetic: the Panda of robots/ under the torques of its own URDF, friction and noise, at 1 kHz. It is
written to a temporary folder (TMPDIR) and removed in the end. `make bench` takes 0.2 GB.
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet

from spelgen.dynamics.regressor import regressor, urdf_parameters
from spelgen.logs.tuning import LogTuning
from spelgen.pipeline.generate import generate
from spelgen.pipeline.loaded_arm import load_arm

ROOT = Path(__file__).parents[1]
URDF = ROOT / "robots" / "panda.urdf"
RATE = 1000.0  # [Hz]
BLOCK = 2**18  # samples of a recording
LIMIT = 2.0  # GB that training may take


def main() -> None:
    """Write, train, tell."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--gigabytes", type=float, default=0.2)
    parser.add_argument("--preset", default="closed-form")
    chosen = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        since = time.monotonic()
        size = write_log(folder / "train.parquet", chosen.gigabytes * 1e9)
        print(f"log: {size / 1e9:.2f} GB of numbers, written in {time.monotonic() - since:.0f} s")
        source = generate(URDF, preset=chosen.preset, width=32)
        (folder / "module.py").write_text(source, encoding="utf-8")
        command = ["train", "module.py", "--data", "train.parquet", "-o", "run", "--set", "progress=false"]
        command += ["--robot", str(URDF), "--objective", "torque"]
        since = time.monotonic()
        subprocess.run([sys.executable, "-m", "spelgen", *command], cwd=folder, check=True)
        peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss * 1024 / 1e9
        print(f"trained in {time.monotonic() - since:.0f} s, at most {peak:.2f} GB resident")
    if peak > LIMIT:
        sys.exit(f"more than {LIMIT} GB")


def write_log(path: Path, least: float) -> int:
    """Recordings of a swinging arm until there are `least` bytes of numbers; returns how many there are."""
    arm = load_arm(URDF).arm
    names = [coordinate.name for coordinate in arm.coordinates]
    t, q, qd, tau = motion(arm, np.random.default_rng(0))
    width = 8 * (1 + 3 * len(names))
    count = -(-int(least) // (width * BLOCK))
    writer = None
    for number in range(count):
        noise = np.random.default_rng([1, number])
        signals = {"q": q, "qd": qd, "tau": tau}
        columns: dict[str, np.ndarray | pa.Array] = {
            "trajectory": pa.array([f"{number}"] * BLOCK).dictionary_encode(),
            "t": t,
        }
        for (quantity, values), size in zip(signals.items(), (1e-5, 1e-3, 0.1), strict=True):
            noisy = values + size * noise.standard_normal(values.shape)
            columns |= {f"{quantity}_{joint}": noisy[:, k] for k, joint in enumerate(names)}
        table = pa.table(columns)
        writer = writer or pa.parquet.ParquetWriter(path, table.schema)
        writer.write_table(table, row_group_size=LogTuning().chunk_samples)
    if writer is not None:
        writer.close()
    return count * width * BLOCK


def motion(arm, random: np.random.Generator) -> tuple[np.ndarray, ...]:
    """Times (T,), and q, qd and tau (T, n) of sums of sines with jittered times, rigid bodies and friction."""
    t = np.cumsum((1 + 0.1 * random.uniform(-1, 1, BLOCK)) / RATE)
    n = len(arm.coordinates)
    middle = np.array([(c.lower + c.upper) / 2 for c in arm.coordinates])
    q, qd, qdd = np.tile(middle, (BLOCK, 1)), np.zeros((BLOCK, n)), np.zeros((BLOCK, n))
    for _ in range(5):
        speed, width = random.uniform(0.3, 4.0, n), random.uniform(0.05, 0.2, n)
        phase = t[:, None] * speed + random.uniform(0, 2 * np.pi, n)
        q += width * np.sin(phase)
        qd += width * speed * np.cos(phase)
        qdd -= width * speed**2 * np.sin(phase)
    parameters = urdf_parameters(arm)
    parts = [
        regressor(arm, q[k : k + 4096], qd[k : k + 4096], qdd[k : k + 4096]) @ parameters
        for k in range(0, BLOCK, 4096)
    ]
    return t, q, qd, np.concatenate(parts) + 0.5 * qd + 0.3 * np.tanh(qd / 0.05)


if __name__ == "__main__":
    main()
