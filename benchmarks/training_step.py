"""How long a training step takes: every preset beside PHNODE as published, and beside its own networks alone.

Six joints, 256 windows of 5 samples, hidden layers of 64 units, rk4 with one step from sample to sample, forward
and backward (the update of the weights is left out). Medians of repeats, taken in turns in one run, on one thread.
PHNODE as published gets its windows in four parts: in one its graph needs 9 GB and takes as long. Then the same
presets with their right-hand side compiled, each with a cold cache; what compiling costs, in s.
"""

from __future__ import annotations

import os
import shutil
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from emitted import network_inputs
from published_phnode import Published

from spelgen.fitting.compiled import Compiled
from spelgen.fitting.rollout import position_difference
from spelgen.fitting.run_folder import load_model
from spelgen.pipeline import build

if TYPE_CHECKING:
    from spelgen.fitting.run_folder import EmittedModel

ROBOT = Path(__file__).parents[1] / "robots" / "six_dof.urdf"
PRESETS = {
    "phnode": ("phnode", "mlp"),
    "spel": ("spel", "mlp"),
    "spel-kan": ("spel-kan", "kan"),
    "minimal": ("minimal", "mlp"),
    "minimal-kan": ("minimal", "kan"),
}
WIDTH, WINDOWS, SAMPLES, JOINTS, STEP = 64, 256, 5, 6, 0.02
PARTS, REPEATS, SLOW_REPEATS = 4, 15, 3


class Data:
    """Random windows: q, qd (W, K, n), tau (W, K-1, n)."""

    def __init__(self, windows: int) -> None:
        generator = torch.Generator().manual_seed(0)
        shape = (windows, SAMPLES, JOINTS)
        self.q, self.qd, tau = (
            torch.randn(shape, dtype=torch.float64, generator=generator) for _ in range(3)
        )
        self.tau = tau[:, 1:]


def rk4(rate: Callable[..., tuple[Tensor, Tensor]], q: Tensor, p: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """q and p one step later, and q' at the start."""
    k1 = rate(q, p)
    k2 = rate(*(torch.add(x, k, alpha=STEP / 2) for x, k in zip((q, p), k1, strict=True)))
    k3 = rate(*(torch.add(x, k, alpha=STEP / 2) for x, k in zip((q, p), k2, strict=True)))
    k4 = rate(*(torch.add(x, k, alpha=STEP) for x, k in zip((q, p), k3, strict=True)))
    slopes = (torch.add(a + d, b + c, alpha=2) for a, b, c, d in zip(k1, k2, k3, k4, strict=True))
    q, p = (torch.add(x, slope, alpha=STEP / 6) for x, slope in zip((q, p), slopes, strict=True))
    return q, p, k1[0]


def training_step(model: nn.Module, data: Data) -> None:
    """Loss of the windows, and its gradient: geodesic distance and velocity, as in eq. 8 of the paper."""
    model.zero_grad()
    prepared = model.prepare()
    q, p = data.q[:, 0], model.momentum(data.q[:, 0], data.qd[:, 0], prepared)
    positions, velocities = [], []
    for tau in data.tau.unbind(dim=1):
        q, p, qd = rk4(lambda q, p, tau=tau: model.rates(q, p, tau, prepared), q, p)
        positions.append(q)
        velocities.append(qd)
    velocities = [*velocities[1:], model.velocity(q, p, prepared)]
    distance = position_difference(torch.stack(positions, dim=1), data.q[:, 1:], model.joint_types)
    velocity = torch.stack(velocities, dim=1) - data.qd[:, 1:]
    (distance.square().mean() + velocity.square().mean()).backward()


def networks_alone(model: nn.Module, data: Data) -> None:
    """The floor: each network forward and backward once for every evaluation in the step, and nothing else."""
    model.zero_grad()
    prepared, q, qd = model.prepare(), data.q[:, 0], data.qd[:, 0]
    total = torch.zeros((), dtype=torch.float64)
    for _ in range(4 * (SAMPLES - 1)):
        features = network_inputs(model, q).requires_grad_()
        total = total + model.mass_network(features, prepared.mass)[0].sum()
        total = total + model.potential_network(features, prepared.potential)[0].sum()
        total = total + model.friction(features, qd, prepared.friction).sum()
        if hasattr(model, "input_network"):
            total = total + model.input_network(features, prepared.input)[0].sum()
    total.backward()


def published_step(model: Published, data: Data) -> None:
    """The same windows for PHNODE as published: state (R, zeta) of all axes."""
    model.zero_grad()
    zero, one = torch.zeros_like(data.q), torch.ones_like(data.q)
    cos, sin = data.q.cos(), data.q.sin()
    rotation = torch.stack([cos, -sin, zero, sin, cos, zero, zero, zero, one], dim=-1).flatten(-2)
    zeta = torch.stack([zero, zero, data.qd], dim=-1).flatten(-2)
    states = torch.cat([rotation, zeta], dim=-1)
    for part in range(PARTS):
        measured, tau = states[part::PARTS], data.tau[part::PARTS]
        state, loss = measured[:, 0], torch.zeros((), dtype=torch.float64)
        for k in range(SAMPLES - 1):
            k1 = model(state, tau[:, k])
            k2 = model(state + STEP / 2 * k1, tau[:, k])
            k3 = model(state + STEP / 2 * k2, tau[:, k])
            k4 = model(state + STEP * k3, tau[:, k])
            state = state + STEP / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
            loss = loss + (state - measured[:, k + 1]).square().mean()
        loss.backward()


def seconds(work: Callable[[], None]) -> float:
    """Time of one call."""
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def emitted_models() -> dict[str, EmittedModel]:
    """The presets' models of the robot."""
    with tempfile.TemporaryDirectory() as folder:
        module, models = Path(folder) / "model.py", {}
        for name, (preset, net) in PRESETS.items():
            module.write_text(build(ROBOT, preset=preset, net=net, width=WIDTH), encoding="utf-8")
            models[name] = load_model(module)
        return models


def sizes(model: nn.Module) -> str:
    """Outputs of the networks of M, D, G and V, and inputs of that of M."""
    friction = getattr(model.friction, "network", None)
    outputs = (
        len(model.mass_network.biases[-1]),
        len(friction.biases[-1]) if friction else model.n,
        len(model.input_network.biases[-1]) if hasattr(model, "input_network") else 0,
        len(model.potential_network.biases[-1]),
    )
    return f"{' '.join(f'{count:4}' for count in outputs)} {model.mass_network.weights[0].shape[1]:7}"


def main() -> None:
    """Print the table."""
    torch.set_num_threads(1)
    torch.manual_seed(0)
    data, models = Data(WINDOWS), emitted_models()
    steps: dict[str, list[float]] = {name: [] for name in models}
    floors: dict[str, list[float]] = {name: [] for name in models}
    for _ in range(REPEATS):
        for name, model in models.items():
            steps[name].append(seconds(lambda model=model: training_step(model, data)))
            floors[name].append(seconds(lambda model=model: networks_alone(model, data)))
    published = Published(JOINTS, WIDTH, WIDTH // 2)
    slow = statistics.median(seconds(lambda: published_step(published, data)) for _ in range(SLOW_REPEATS))
    count = sum(parameter.numel() for parameter in published.parameters())
    print(
        f"{'':12}      step  networks alone  published /  phnode /  parameters  outputs: M    D    G    V  inputs"
    )
    print(f"{'published':12} {1e3 * slow:6.0f} ms {1:29} {'':10} {count:11}")
    fast = statistics.median(steps["phnode"])
    for name, model in models.items():
        step, floor = statistics.median(steps[name]), statistics.median(floors[name])
        count = sum(parameter.numel() for parameter in model.parameters())
        print(
            f"{name:12} {1e3 * step:6.1f} ms {1e3 * floor:7.1f} ms {step / floor:4.1f}x {slow / step:11.0f}"
            f" {fast / step:10.1f} {count:11}       {sizes(model)}"
        )
    if shutil.which("g++"):
        print_compiled(models, data, {name: statistics.median(times) for name, times in steps.items()})


def print_compiled(models: dict[str, EmittedModel], data: Data, plain: dict[str, float]) -> None:
    """Print what compiling brings and costs."""
    print(f"\n{'compiled':12}      step    gain  compiling")
    for name, model in models.items():
        with tempfile.TemporaryDirectory() as folder:
            os.environ["TORCHINDUCTOR_CACHE_DIR"] = folder
            torch._dynamo.reset()  # as in a process of its own
            ready = Compiled(model)
            compiling = seconds(lambda ready=ready: training_step(ready, data))
            step = statistics.median(
                seconds(lambda ready=ready: training_step(ready, data)) for _ in range(REPEATS)
            )
        print(f"{name:12} {1e3 * step:6.1f} ms {plain[name] / step:6.2f}x {compiling:8.1f} s", flush=True)


if __name__ == "__main__":
    main()
