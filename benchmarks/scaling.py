"""How a training step grows with joints and with windows: windows a second, and memory of the gradient's graph.

    python benchmarks/scaling.py [--device cuda]

Chains of 2 to 12 turning joints whose axes alternate, windows of 5 samples, rk4 with one step from sample to sample,
forward and backward in double precision, one thread. Medians. The last column is the exponent with which the time of a
window grows from the arm of half as many joints.
"""

from __future__ import annotations

import argparse
import math
import statistics
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING

import torch

from spelgen.building import build
from spelgen.fitting.rollout import loss_scales, rollout_loss
from spelgen.logs.windows import Windows

if TYPE_CHECKING:
    from spelgen.emission.loading import EmittedModel

JOINTS, BATCHES, SAMPLES, STEP = (2, 3, 4, 6, 8, 12), (16, 64, 256, 1024), 5, 0.01
REPEATS = 5
LINK = """<link name="l{k}"><inertial><origin xyz="0.1 0.02 0.2"/><mass value="{mass}"/>
<inertia ixx="0.02" iyy="0.02" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>"""
JOINT = """<joint name="j{k}" type="revolute"><parent link="l{before}"/><child link="l{k}"/><origin xyz="0 0 0.3"/>
<axis xyz="{axis}"/><limit lower="-2" upper="2" effort="50" velocity="3"/></joint>"""


def main() -> None:
    """Print a row for each preset and number of joints."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--presets", default="closed-form,phnode,spel")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
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
    """A chain with alternating axes, as a file."""
    parts = ['<link name="l0"/>']
    for k in range(1, joints + 1):
        axis = ("0 0 1", "0 1 0", "1 0 0")[k % 3]
        parts += [LINK.format(k=k, mass=5 / k), JOINT.format(k=k, before=k - 1, axis=axis)]
    path = Path(tempfile.mkdtemp()) / f"chain{joints}.urdf"
    path.write_text(f'<robot name="chain{joints}">{"".join(parts)}</robot>')
    return path


def _windows(model: EmittedModel, count: int) -> Windows:
    generator = torch.Generator().manual_seed(0)
    shape = (count, SAMPLES, model.n)
    q, qd, tau = (torch.randn(shape, dtype=torch.float64, generator=generator) for _ in range(3))
    dt = torch.full((count, SAMPLES - 1), STEP, dtype=torch.float64)
    return Windows(dt, q, qd, tau[:, 1:]).to(next(model.parameters()).device)


def _step(model: EmittedModel, windows: Windows) -> None:
    rollout_loss(model, windows, loss_scales(windows, model.joint_types), 1).backward()
    if windows.q.is_cuda:
        torch.cuda.synchronize()


def _rate(model: EmittedModel, batch: int) -> float:
    """Windows a second."""
    windows, times = _windows(model, batch), []
    clock = time.perf_counter if windows.q.is_cuda else time.process_time  # others may use the processor
    for _ in range(REPEATS + 1):
        since = clock()
        _step(model, windows)
        times.append(clock() - since)
    return batch / statistics.median(times[1:])


def _memory(model: EmittedModel) -> float:
    """Bytes that a window more keeps for the gradient."""
    held = []
    for count in (64, 128):
        kept: dict[int, int] = {}

        def keep(x: torch.Tensor, kept: dict[int, int] = kept) -> torch.Tensor:
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
