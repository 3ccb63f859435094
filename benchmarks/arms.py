"""Arm by baseline by preset: torque errors on real logs, and on a simulated arm with what rigid bodies miss.

    python benchmarks/arms.py [LOGS]

LOGS is ../shared/logs beside the checkout by default. nMSE: mean squared torque error by the torque's variance, mean of
the joints, pauses included. Everything is fitted to the same training samples with the defaults of spelgen; the two
networks, two hidden layers of 64 tanh units on q, qd and qdd, are stopped by a fifth of those samples, as a careful
user would stop them.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).parent))
sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from motions import smooth_motion
from real_logs import TESTS, TRAINING, after, first, mean, read, samples_of, torque_of
from torch import nn

from spelgen.building import build
from spelgen.dynamics.bristles import bristle_reach, bristles_along
from spelgen.fitting.torque_fit import fit_torque
from spelgen.identification.friction import FrictionModel
from spelgen.identification.identify import least_squares
from spelgen.identification.method import LeastSquares
from spelgen.identification.samples import DynamicsSamples
from spelgen.loaded_arm import load_arm

Torque = Callable[..., np.ndarray]
Case = tuple[str, Path, list[DynamicsSamples], list[DynamicsSamples]]
"""Name, URDF, training samples, test samples."""

SPLITS = {"xmate3": 12.0, "ar5": 36.0}  # s of training
WIDTH, EPOCHS, PATIENCE, BATCH = 64, 400, 30, 512
ROBOT = Path(__file__).parents[1] / "robots" / "ur10e.urdf"
EFFECTS = {
    "spring": "a spring of 120 Nm at joint 2 and of 8 Nm/rad at joint 1",
    "ripple": "gear ripple, 50 waves in a turn, of 5, 6, 4, 1, 1 and 1 Nm",
    "friction": "friction that varies by half with position",
}


def main() -> None:
    torch.set_num_threads(1)
    logs = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parents[2] / "shared" / "logs"
    print("Torque nMSE on real logs\n")
    table(real(logs))
    print("\nA simulated UR10e with: " + "; ".join(f"{k}, {x}" for k, x in EFFECTS.items()) + "\n")
    table(simulated())


def table(cases: Iterator[Case]) -> None:
    head = ("network", "least sq.", "+ network", "+ memory", "closed-form", "minimal", "fits [s]")
    print(f"{'':18}" + "".join(f"{x:>12}" for x in head))
    for name, urdf, training, tests in cases:
        arm, times = load_arm(urdf).arm, []
        plain = least_squares(arm, training, LeastSquares("range")).torque
        memory = LeastSquares("range", friction=FrictionModel(memory=True))
        row = [
            network(training),
            plain,
            network(training, plain),
            least_squares(arm, training, memory).torque,
        ]
        for preset in ("closed-form", "minimal"):
            model, since = build(urdf, preset), time.perf_counter()
            fit_torque(model, training)
            times.append(f"{time.perf_counter() - since:.0f}")
            row.append(torque_of(model))
        errors = "".join(f"{mean(each, tests):12.5f}" for each in row)
        print(f"{name:18}{errors}{', '.join(times):>12}", flush=True)


def real(folder: Path) -> Iterator[Case]:
    """The arms of the reference logs, with the splits that its README gives."""
    urdf = folder / "ur10e" / "ur10e.urdf"
    arm = load_arm(urdf).arm
    logs = {x: read(folder / "ur10e" / f"{x}.parquet", arm) for x in (*TRAINING, *TESTS)}
    yield "UR10e, nine", urdf, samples_of([logs[x] for x in TRAINING]), judged([logs[x] for x in TESTS])
    urdf = folder.parent / "arms" / "panda_erd.urdf"
    whole = read(folder / "panda" / "exciting_traj1.parquet", load_arm(urdf).arm)
    yield "Panda", urdf, samples_of([first(whole, 12.0)]), judged([after(whole, 12.0)])
    for name, seconds in SPLITS.items():
        urdf = folder / name / f"{name}.urdf"
        (log,) = (folder / name).glob("*.parquet")
        whole = read(log, load_arm(urdf).arm)
        yield name, urdf, samples_of([first(whole, seconds)]), judged([after(whole, seconds)])
    urdf = folder / "shanghai" / "shanghai.urdf"
    arm = load_arm(urdf).arm
    each = [read(log, arm) for log in sorted((folder / "shanghai").glob("*.parquet"))]
    for k, test in enumerate(each):
        others = samples_of([x for x in each if x is not test])
        yield f"shanghai {k + 1}", urdf, others, judged([test])


def judged(logs: Sequence[Any]) -> list[DynamicsSamples]:
    return samples_of(logs, pauses=True)


def simulated() -> Iterator[Case]:
    """A UR10e other than its URDF says, with one effect and with all of them."""
    true = build(ROBOT, "closed-form")
    rng = np.random.default_rng(0)
    with torch.no_grad():
        for name, weight in true.named_parameters():
            deviation = 0.1 if "inertial" in name else 0.3
            weight += deviation * torch.from_numpy(rng.normal(size=weight.shape))
    for chosen in (*((x,) for x in EFFECTS), tuple(EFFECTS)):
        logs = [recorded(true, chosen, seed, noise=0.02) for seed in (1, 2)]
        yield " + ".join(chosen) if len(chosen) < 2 else "all", ROBOT, logs, [recorded(true, chosen, 9)]


def recorded(model: Any, effects: Sequence[str], seed: int, noise: float = 0.0) -> DynamicsSamples:
    """30 s of a smooth random motion with the model's torque and what else acts; noise by the torque's deviation."""
    rng = np.random.default_rng(seed)
    q, qd, qdd = smooth_motion(model.n, 30.0, rng)
    z = bristles_along(q, bristle_reach(model))
    states = [torch.from_numpy(x) for x in (q, qd, qdd, z)]
    with torch.no_grad():
        tau = model.inverse_dynamics(*states).numpy()
        friction = model.friction_torque(*states[:2], states[3]).numpy()
    if "spring" in effects:
        tau[:, 1] += 120 * np.sin(q[:, 1] - 0.4)
        tau[:, 0] += 8 * q[:, 0]
    if "ripple" in effects:
        tau += np.array([5, 6, 4, 1, 1, 1]) * np.sin(50 * q + 0.3)
    if "friction" in effects:
        tau += 0.5 * np.sin(q + 0.7) * friction
    tau += noise * tau.std(axis=0) * rng.normal(size=tau.shape)
    return DynamicsSamples("simulated", q, qd, qdd, tau, z)


def network(training: Sequence[DynamicsSamples], beside: Torque | None = None) -> Torque:
    """A network of q, qd and qdd, fitted to torques, or to what another predictor leaves of them."""

    def inputs(q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
        return np.concatenate([q, qd, qdd], axis=-1)

    x = np.concatenate([inputs(s.q, s.qd, s.qdd) for s in training])
    known = [0 * s.tau if beside is None else beside(s.q, s.qd, s.qdd, s.z) for s in training]
    y = np.concatenate([s.tau - k for s, k in zip(training, known, strict=True)])
    moved, scale = (x.mean(0), x.std(0) + 1e-9), (y.mean(0), y.std(0) + 1e-9)
    x, y = ((a - center) / size for a, (center, size) in ((x, moved), (y, scale)))
    out = np.arange(len(x)) * 10 // len(x) % 5 == 4  # blocks, for samples beside one another are alike
    torch.manual_seed(0)
    layers = [nn.Linear(x.shape[1], WIDTH), nn.Tanh(), nn.Linear(WIDTH, WIDTH), nn.Tanh()]
    model = nn.Sequential(*layers, nn.Linear(WIDTH, y.shape[1])).double()
    optimizer = torch.optim.AdamW(model.parameters(), lr=1e-3)
    seen, held = ([torch.from_numpy(a[rows]) for a in (x, y)] for rows in (~out, out))
    best, weights, waits = np.inf, model.state_dict(), 0
    for _ in range(EPOCHS):
        for batch in torch.randperm(len(seen[0])).split(BATCH):
            optimizer.zero_grad()
            (model(seen[0][batch]) - seen[1][batch]).square().mean().backward()
            optimizer.step()
        with torch.no_grad():
            loss = float((model(held[0]) - held[1]).square().mean())
        waits = 0 if loss < best else waits + 1
        if loss < best:
            best, weights = loss, {name: value.clone() for name, value in model.state_dict().items()}
        if waits > PATIENCE:
            break
    model.load_state_dict(weights)

    def torque(q: np.ndarray, qd: np.ndarray, qdd: np.ndarray, z: np.ndarray | None = None) -> np.ndarray:
        with torch.no_grad():
            found = model(torch.from_numpy((inputs(q, qd, qdd) - moved[0]) / moved[1])).numpy()
        return found * scale[1] + scale[0] + (0 if beside is None else beside(q, qd, qdd, z))

    return torque


if __name__ == "__main__":
    main()
