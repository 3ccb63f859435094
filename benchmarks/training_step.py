"""Times of a training step: every preset, compared with PHNODE and with only the networks of the preset.

PHNODE is the port-Hamiltonian neural network of Duong et al. (IEEE T-RO 40:3695, 2024). It has three rows: `published`
computes dM^-1/dt with an automatic derivative per entry of the matrix; `with jvp` computes it with one forward-mode
derivative, as a user who knows torch would; the preset `phnode` has explicit derivatives.

A step is the loss and its gradient, without the update of the weights: six joints, 256 windows of 5 samples, hidden
layers of 64 units, rk4 with one step from sample to sample. Times are medians of repeats, alternated in one run, on one
thread. The column "bound" is the share of a step's time that a step without the bound saves; the bound keeps M positive
definite. `published` and `with jvp` divide the windows into four parts: the graph of all windows would need 9 GB, and
the time would be the same.
"""

from __future__ import annotations

import copy
import math
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from emitted import NETWORKS, network_inputs
from published_phnode import ByJvp, Published

from spelgen.design import Design
from spelgen.dynamics.equations import unbounded
from spelgen.emission.build import build
from spelgen.fitting.rollout import position_difference

if TYPE_CHECKING:
    from spelgen.emission.assemble import ArmModel

ROBOT = Path(__file__).parents[1] / "robots" / "six_dof.urdf"
PRESETS: dict[str, str | Design] = {
    "phnode": "phnode",
    "spel": "spel",
    "spel-kan": "spel-kan",
    "derived M, V": NETWORKS,
    "hybrid": "hybrid",
    "closed-form": "closed-form",
}
WIDTH, WINDOWS, SAMPLES, JOINTS, STEP = 64, 256, 5, 6, 0.02
PARTS, REPEATS, SLOW_REPEATS = 4, 15, 3


class Data:
    """Random training windows, W of K samples: q and qd, (W, K, n), and tau between samples, (W, K-1, n)."""

    def __init__(self, windows: int) -> None:
        generator = torch.Generator().manual_seed(0)
        shape = (windows, SAMPLES, JOINTS)
        self.q, self.qd, tau = (
            torch.randn(shape, dtype=torch.float64, generator=generator) for _ in range(3)
        )
        self.tau = tau[:, 1:]


def rk4(rate: Callable[..., tuple[Tensor, Tensor]], q: Tensor, p: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return q and p after one step of rk4, and dq/dt at its start, (..., n) each; rate: gives dq/dt and dp/dt."""
    k1 = rate(q, p)
    k2 = rate(*(torch.add(x, k, alpha=STEP / 2) for x, k in zip((q, p), k1, strict=True)))
    k3 = rate(*(torch.add(x, k, alpha=STEP / 2) for x, k in zip((q, p), k2, strict=True)))
    k4 = rate(*(torch.add(x, k, alpha=STEP) for x, k in zip((q, p), k3, strict=True)))
    slopes = (torch.add(a + d, b + c, alpha=2) for a, b, c, d in zip(k1, k2, k3, k4, strict=True))
    q, p = (torch.add(x, slope, alpha=STEP / 6) for x, slope in zip((q, p), slopes, strict=True))
    return q, p, k1[0]


def plain_mass(model: ArmModel) -> ArmModel | None:
    """Return a copy of the model without the bound that keeps M positive definite; None if its M has no bound."""
    if not hasattr(getattr(model, "mass", None), "fraction"):
        return None
    plain = copy.deepcopy(model)
    plain.mass.fraction = unbounded
    return plain


def training_step(model: ArmModel, data: Data) -> None:
    """Compute the loss of windows of a trajectory, and its gradient with respect to the model's parameters.

    The loss is the sum of geodesic position errors and of velocity errors (Duong et al., IEEE T-RO 2024, eq. 8).
    """
    model.zero_grad()
    prepared = model.prepare()
    q, p = data.q[:, 0], model.momentum(model.at(data.q[:, 0], prepared=prepared), data.qd[:, 0])
    positions, velocities = [], []
    for tau in data.tau.unbind(dim=1):
        q, p, qd = rk4(lambda q, p, tau=tau: model.port_hamiltonian_rhs(q, p, tau, prepared), q, p)
        positions.append(q)
        velocities.append(qd)
    velocities = [*velocities[1:], model.velocity(model.at(q, prepared=prepared), p)]
    distance = position_difference(torch.stack(positions, dim=1), data.q[:, 1:], model.joint_types)
    velocity = torch.stack(velocities, dim=1) - data.qd[:, 1:]
    (distance.square().mean() + velocity.square().mean()).backward()


def networks_alone(model: ArmModel, data: Data) -> None:
    """Evaluate the model's networks as often as a training step does, forward and backward, and nothing else."""
    model.zero_grad()
    dynamics, q, qd = model, data.q[:, 0], data.qd[:, 0]
    prepared = dynamics.prepare()
    total = torch.zeros((), dtype=torch.float64)
    for _ in range(4 * (SAMPLES - 1)):
        features = network_inputs(model, q).requires_grad_()
        layers = prepared["mass"]
        total = total + dynamics.mass.network(features, layers)[0].sum()
        total = total + dynamics.potential(features, prepared["potential"])[0].sum()
        total = total + dynamics.friction(features, qd, prepared["friction"], qd.unsqueeze(-1)).sum()
        if hasattr(dynamics, "input_network"):
            total = total + dynamics.input_network(features, prepared["input"])[0].sum()
    total.backward()


def published_step(model: Published, data: Data) -> None:
    """Compute the loss of windows and its gradient by PHNODE as published; its states are rotation R and twist zeta."""
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
    """Return the wall time of one call of `work` [s]."""
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def sizes(model: ArmModel) -> str:
    """Return the numbers of outputs of a model's networks, and of inputs of the network of M, as text; "" without M.

    The outputs are of the networks of M (mass matrix), D (friction), G (input matrix) and V (potential energy).
    """
    if not hasattr(model, "mass"):
        return ""
    mass, friction = (getattr(part, "network", None) for part in (model.mass, model.friction))
    given, potential = getattr(model, "input_network", None), model.potential
    outputs = (
        len(mass.biases[-1]),
        len(friction.biases[-1]) if friction else model.n,
        len(given.biases[-1]) if given else 0,
        len(potential.biases[-1]),
    )
    return f"{' '.join(f'{count:4}' for count in outputs)} {int(mass.mask0.flatten(1).any(dim=0).sum()):7}"


def median(times: list[float]) -> float:
    """Return the median of times [s]; NaN if there are none."""
    return statistics.median(times or [math.nan])


def main() -> None:
    """Print the time of a training step [ms] of each preset and of both published forms of PHNODE (see the module).

    The columns "published /", "with jvp /" and "phnode /" have the time of this form of PHNODE divided by the time of
    the row.
    """
    torch.set_num_threads(1)
    torch.manual_seed(0)
    data = Data(WINDOWS)
    models = {name: build(ROBOT, preset, width=WIDTH) for name, preset in PRESETS.items()}
    plain = {name: plain_mass(model) for name, model in models.items()}
    steps, floors, bare = ({name: list[float]() for name in models} for _ in range(3))
    for _ in range(REPEATS):
        for name, model in models.items():
            steps[name].append(seconds(lambda model=model: training_step(model, data)))
            if (free := plain[name]) is not None:
                bare[name].append(seconds(lambda model=free: training_step(model, data)))
            if hasattr(model, "mass"):
                floors[name].append(seconds(lambda model=model: networks_alone(model, data)))
    rivals = {"published": Published(JOINTS, WIDTH, WIDTH // 2), "with jvp": ByJvp(JOINTS, WIDTH, WIDTH // 2)}
    slow = {
        name: median([seconds(lambda model=model: published_step(model, data)) for _ in range(SLOW_REPEATS)])
        for name, model in rivals.items()
    }
    count = sum(parameter.numel() for parameter in rivals["published"].parameters())
    print(
        f"{'':12}      step   bound  networks alone  published /  with jvp /  phnode /  parameters"
        "  outputs: M    D    G    V  inputs"
    )
    for name, step in slow.items():
        ratios = f"{slow['published'] / step:12.0f} {slow['with jvp'] / step:12.1f}"
        print(f"{name:12} {1e3 * step:7.0f} ms {'':25}{ratios} {'':10} {count:11}")
    fast = median(steps["phnode"])
    for name, model in models.items():
        step, floor = median(steps[name]), median(floors[name])
        share = 1 - median([without / whole for without, whole in zip(bare[name], steps[name], strict=False)])
        count = sum(parameter.numel() for parameter in model.parameters())
        bound = "" if math.isnan(share) else f"{share:.1%}"
        alone = "" if math.isnan(floor) else f"{1e3 * floor:7.1f} ms {step / floor:4.1f}x"
        print(
            f"{name:13} {1e3 * step:6.1f} ms {bound:>7} {alone:16} {slow['published'] / step:12.0f}"
            f" {slow['with jvp'] / step:12.1f} {fast / step:10.1f} {count:11}       {sizes(model)}"
        )


if __name__ == "__main__":
    main()
