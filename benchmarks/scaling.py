"""Time and memory of fits, and how they grow with joints, samples and windows.

    python benchmarks/scaling.py [--device cuda]

The arms are chains of turning joints with alternating axes; one thread is used.

First table: fits of closed-form models to torques at 100 Hz, each in its own process: processor time and peak memory,
for 10,000 and 1,000,000 samples and for 8 and 16 joints.

Second table: training steps (the loss of predicted windows of 5 samples, and its gradient) in double precision; rk4
with one step from sample to sample. Columns: windows per second for several batch sizes, memory per window that
autograd keeps for the gradient, and an exponent: log2(time per window with n joints / time with n/2 joints), so that 1
means a time in proportion to n. Times are medians.
"""

from __future__ import annotations

import argparse
import math
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch

from spelgen.emission.build import build
from spelgen.fitting.fit import fit
from spelgen.fitting.rollout import loss_scales, rollout_loss
from spelgen.logs.trajectory import Trajectory
from spelgen.logs.windows import Windows

if TYPE_CHECKING:
    from spelgen.emission.assemble import ArmModel

JOINTS, BATCHES, SAMPLES, STEP = (2, 3, 4, 6, 8, 12), (16, 64, 256, 1024), 5, 0.01
REPEATS = 5
FREQUENCIES = (0.05, 0.5)  # [Hz] lowest and highest sine of the simulated motion
LINK = """<link name="l{k}"><inertial><origin xyz="0.1 0.02 0.2"/><mass value="{mass}"/>
<inertia ixx="0.02" iyy="0.02" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>"""
JOINT = """<joint name="j{k}" type="revolute"><parent link="l{before}"/><child link="l{k}"/><origin xyz="0 0 0.3"/>
<axis xyz="{axis}"/><limit lower="-2" upper="2" effort="50" velocity="3"/></joint>"""


def main() -> None:
    """Print time and memory of fits to torques, and of training steps (loss and gradient) on windows of samples.

    With --fit, print only processor time [s] and peak memory [GB] of one fit.
    """
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--presets", default="closed-form,phnode,spel")
    parser.add_argument("--fit", nargs=2, type=int, metavar=("JOINTS", "SAMPLES"), help="one fit alone")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    if arguments.fit:
        print(*measured_fit(*arguments.fit))
        return
    compare_fits()
    compare_steps(arguments)


def compare_fits() -> None:
    """Print time and memory of fits to torques, and the growth of the time with samples and joints.

    Goals: 100 times the samples take at most 12 times as long, and 16 joints at most 3 times as long as 8.
    """
    costs = {}
    for joints, samples in ((6, 10_000), (6, 1_000_000), (8, 20_000), (16, 20_000)):
        command = [sys.executable, __file__, "--fit", str(joints), str(samples)]
        seconds, gigabytes = subprocess.run(
            command, check=True, capture_output=True, text=True
        ).stdout.split()
        costs[joints, samples] = float(seconds)
        print(f"{joints:3} joints, {samples:9,} samples: {float(seconds):6.1f} s, {gigabytes} GB", flush=True)
    more_samples = costs[6, 1_000_000] / costs[6, 10_000]
    more_joints = costs[16, 20_000] / costs[8, 20_000]
    print(f"100 times the samples take {more_samples:.1f} times as long, goal 12")
    print(f"16 joints take {more_joints:.1f} times as long as 8, goal 3")


def measured_fit(joints: int, samples: int) -> tuple[str, str]:
    """Return the processor time [s] of a fit, and the peak memory of this process [GB], as text."""
    urdf = _urdf(joints)
    # the log is simulated in another process, so that its memory does not count
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        log = pool.submit(_recorded, urdf, samples).result()
    since = time.process_time()
    fit(build(urdf, "closed-form"), log)
    seconds = time.process_time() - since
    return f"{seconds:.1f}", f"{resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20:.2f}"


def _recorded(urdf: Path, samples: int) -> Trajectory:
    """Return a log of a smooth motion, with noisy torques of an arm whose parameters differ from the URDF's."""
    torch.set_num_threads(1)
    model, generator = build(urdf, "closed-form"), np.random.default_rng(0)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter += torch.from_numpy(generator.normal(0, 0.2, parameter.shape))
    shape = (5, model.n)
    speed = 2 * np.pi * generator.uniform(*FREQUENCIES, shape)
    phase, size = generator.uniform(0, 2 * np.pi, shape), generator.uniform(0.1, 0.4, shape)
    t = 0.01 * np.arange(samples)
    blocks = []
    for part in np.array_split(t, -(-samples // 10_000)):
        angle = speed * part[:, None, None] + phase
        waves = size * np.sin(angle), size * speed * np.cos(angle), -size * speed**2 * np.sin(angle)
        q, qd, qdd = (torch.from_numpy(wave.sum(axis=1)) for wave in waves)
        with torch.no_grad():
            blocks.append((q, qd, model.inverse_dynamics(q, qd, qdd)))
    q, qd, tau = (torch.cat(column).numpy() for column in zip(*blocks, strict=True))
    noise = 0.02 * tau.std(axis=0) * generator.normal(size=tau.shape)
    return Trajectory(t=t, q=q, qd=qd, tau=tau + noise)


def compare_steps(arguments: argparse.Namespace) -> None:
    """Print windows per second, memory per window [kB] and an exponent, per preset and number of joints n.

    The exponent is log2(time per window with n joints / time per window with n / 2 joints).
    """
    heads = "".join(f"{batch:>9}" for batch in BATCHES)
    print(f"{'windows/s at a batch of':24}{heads}  kB/window  exponent")
    for preset in arguments.presets.split(","):
        took: dict[int, float] = {}
        for joints in JOINTS:
            model = build(_urdf(joints), preset, width=32, depth=2).to(arguments.device)
            rates = [_rate(model, batch) for batch in BATCHES]
            took[joints] = 1 / max(rates)
            half = took.get(joints // 2) if joints % 2 == 0 else None
            grown = "" if half is None else f"{math.log2(took[joints] / half):10.2f}"
            cells = "".join(f"{rate:9.0f}" for rate in rates)
            print(f"{preset:14}{joints:3} joints {cells}{_memory(model) / 1e3:11.0f}{grown}", flush=True)


def _urdf(joints: int) -> Path:
    """Write the URDF of a serial chain of turning joints with alternating axes; return its path."""
    parts = ['<link name="l0"/>']
    for k in range(1, joints + 1):
        axis = ("0 0 1", "0 1 0", "1 0 0")[k % 3]
        parts += [LINK.format(k=k, mass=5 / k), JOINT.format(k=k, before=k - 1, axis=axis)]
    path = Path(tempfile.mkdtemp()) / f"chain{joints}.urdf"
    path.write_text(f'<robot name="chain{joints}">{"".join(parts)}</robot>')
    return path


def _windows(model: ArmModel, count: int) -> Windows:
    generator = torch.Generator().manual_seed(0)
    shape = (count, SAMPLES, model.n)
    q, qd, tau = (torch.randn(shape, dtype=torch.float64, generator=generator) for _ in range(3))
    dt = torch.full((count, SAMPLES - 1), STEP, dtype=torch.float64)
    return Windows(dt, q, qd, tau[:, 1:]).to(next(model.parameters()).device)


def _step(model: ArmModel, windows: Windows) -> None:
    rollout_loss(model, windows, loss_scales(windows, model.joint_types), 1).backward()
    if windows.q.is_cuda:
        torch.cuda.synchronize()


def _rate(model: ArmModel, batch: int) -> float:
    """Return the number of windows per second of a training step with `batch` windows, by the median time."""
    windows, times = _windows(model, batch), []
    # processor time, which other processes do not affect; on a GPU wall time
    clock = time.perf_counter if windows.q.is_cuda else time.process_time
    for _ in range(REPEATS + 1):
        since = clock()
        _step(model, windows)
        times.append(clock() - since)
    return batch / statistics.median(times[1:])


def _memory(model: ArmModel) -> float:
    """Return the memory per window of tensors that autograd keeps for the gradient of the loss [bytes]."""
    held = []
    for count in (64, 128):
        kept: dict[int, int] = {}

        def keep(x: torch.Tensor, kept: dict[int, int] = kept) -> torch.Tensor:
            """Add the storage of a tensor x that autograd saves to `kept`, {address: size [bytes]}; return x."""
            kept[x.untyped_storage().data_ptr()] = x.untyped_storage().nbytes()
            return x

        with torch.autograd.graph.saved_tensors_hooks(keep, lambda x: x):
            windows = _windows(model, count)
            loss = rollout_loss(model, windows, loss_scales(windows, model.joint_types), 1)
        held.append(sum(kept.values()))
        del loss
    return (held[1] - held[0]) / 64


if __name__ == "__main__":
    main()
