"""Arm by baseline by preset: torques and states ahead on real logs, and torques of an arm with what rigid bodies miss.

    python benchmarks/arms.py [FOLDER]

FOLDER is made by `python benchmarks/recordings.py FOLDER`, by default runs/recordings. nMSE: mean squared torque
error by the torque's variance, mean of the joints, pauses included. The presets are fitted as `spelgen train` does,
everything else to the same samples. Networks have two hidden layers of 64 units: one of q, qd and qdd; the same for
what least squares leaves; and a Deep Lagrangian network (Lutter, Ritter and Peters, ICLR 2019: a factor of M, and V)
with viscous and Coulomb friction of each joint beside it. They are stopped, and the ridge is chosen, by a fifth of
those samples, as a careful user would. States 0.1, 0.5 and 1 s ahead: error relative to the motion, as `spelgen
evaluate` has it, open loop and with the disturbance held that a momentum observer finds.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).parent))
sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from motions import smooth_motion
from real_logs import (
    RIDGES,
    TESTS,
    TRAINING,
    Torque,
    after,
    first,
    least_squares_torque,
    mean,
    read,
    ridge,
    samples_of,
    torque_of,
    trained,
)
from recordings import folder_of, panda_urdf
from torch import Tensor, nn
from torch.func import grad, jvp

import spelgen
from spelgen.arm.arm import Chain
from spelgen.arm.configured_arm import load_arm
from spelgen.baselines.names import CONSTANT_VELOCITY, MODEL, observed
from spelgen.dynamics.bristles import bristle_reach, bristles_along
from spelgen.dynamics.friction import FrictionModel
from spelgen.dynamics.pinocchio_dynamics import drives_known, urdf_dynamics
from spelgen.emission.build import build
from spelgen.fitting.torque.fit import fit_torque
from spelgen.logs.dynamics_samples import DynamicsSamples
from spelgen.logs.trajectory import Trajectory

Split = tuple[str, Path, list[Trajectory], list[Trajectory]]

PRESETS = ("closed-form", "hybrid")


@dataclass(frozen=True)
class Case:
    """Training and test samples of an arm, and by preset the model that was fitted, with the seconds that it took."""

    name: str
    urdf: Path
    training: list[DynamicsSamples]
    tests: list[DynamicsSamples]
    models: dict[str, tuple[Any, float]]


AHEAD = (0.1, 0.5, 1.0)  # s
SMOOTHING = 0.02  # rad/s, of the Deep Lagrangian network's Coulomb friction

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
    logs = folder_of(sys.argv[1] if len(sys.argv) > 1 else None)
    print("Torque nMSE on real logs\n")
    table(real(logs))
    print("\nStates ahead on real logs, error relative to the motion\n")
    states_ahead(logs)
    print("\nA simulated UR10e with: " + "; ".join(f"{k}, {x}" for k, x in EFFECTS.items()) + "\n")
    table(simulated())


def table(cases: Iterator[Case]) -> None:
    head = (
        "URDF",
        "network",
        "DeLaN",
        "ridge",
        "least sq.",
        "+ network",
        "+ memory",
        "closed-form",
        "hybrid",
    )
    print(f"{'':18}" + "".join(f"{x:>12}" for x in head) + "    fits [s]")
    for case in cases:
        arm, training = load_arm(case.urdf).chain, case.training
        plain = least_squares_torque(arm, training, FrictionModel())
        row = [
            of_the_urdf(case.urdf, arm),
            network(training),
            deep_lagrangian(training),
            best_ridge(arm, training),
            plain,
            network(training, plain),
            least_squares_torque(arm, training, FrictionModel(memory=True)),
            *(torque_of(model) for model, _ in case.models.values()),
        ]
        errors = "".join(f"{mean(each, case.tests):12.5f}" for each in row)
        times = ", ".join(f"{seconds:.0f}" for _, seconds in case.models.values())
        print(f"{case.name:18}{errors}{times:>12}", flush=True)


def states_ahead(folder: Path) -> None:
    """What `spelgen evaluate` says of each arm."""
    predictors = (CONSTANT_VELOCITY, MODEL, observed(MODEL))
    print(f"{'':30}" + "".join(f"{f'{name}, {ahead:g} s':>30}" for ahead in AHEAD for name in predictors))
    for name, urdf, training, tests in splits(folder):
        for preset in PRESETS:
            fit = trained(urdf, training, preset)
            row = []
            for horizon in spelgen.evaluate(fit, tests, seconds=AHEAD, steps=()).horizons:
                row += [horizon.errors[x].mean_relative_rms or np.inf for x in predictors]
            print(f"{f'{name}, {preset}':30}" + "".join(f"{x:30.3f}" for x in row), flush=True)


def splits(folder: Path) -> Iterator[Split]:
    """The arms of the reference logs, with the splits that its README gives."""
    urdf = folder / "ur10e" / "ur10e.urdf"
    arm = load_arm(urdf).chain
    logs = {x: read(folder / "ur10e" / f"{x}.parquet", arm) for x in (*TRAINING, *TESTS)}
    yield "UR10e, nine", urdf, [logs[x] for x in TRAINING], [logs[x] for x in TESTS]
    urdf = panda_urdf(folder)
    whole = read(folder / "panda" / "exciting_traj1.parquet", load_arm(urdf).chain)
    yield "Panda", urdf, [first(whole, 12.0)], [after(whole, 12.0)]
    for name, seconds in SPLITS.items():
        urdf = folder / name / f"{name}.urdf"
        (log,) = (folder / name).glob("*.parquet")
        whole = read(log, load_arm(urdf).chain)
        yield name, urdf, [first(whole, seconds)], [after(whole, seconds)]
    urdf = folder / "shanghai" / "shanghai.urdf"
    arm = load_arm(urdf).chain
    each = [read(log, arm) for log in sorted((folder / "shanghai").glob("*.parquet"))]
    for k, test in enumerate(each):
        yield f"shanghai {k + 1}", urdf, [x for x in each if x is not test], [test]


def real(folder: Path) -> Iterator[Case]:
    """The same, as samples of torque."""
    for name, urdf, training, tests in splits(folder):
        fits, models = {}, {}
        for preset in PRESETS:
            since = time.perf_counter()
            fits[preset] = trained(urdf, training, preset)
            models[preset] = fits[preset].model, time.perf_counter() - since
        fit = fits["closed-form"]
        yield Case(name, urdf, samples_of(fit, training), samples_of(fit, tests, pauses=True), models)


def simulated() -> Iterator[Case]:
    """A UR10e other than its URDF says, with one effect and with all of them."""
    for name, logs, test in with_effects():
        models = {}
        for preset in PRESETS:
            model, since = build(ROBOT, preset), time.perf_counter()
            fit_torque(model, logs)
            models[preset] = model, time.perf_counter() - since
        yield Case(name, ROBOT, logs, [test], models)


def with_effects() -> Iterator[tuple[str, list[DynamicsSamples], DynamicsSamples]]:
    """Names of effects, with the training logs and the test of an arm that has them."""
    true = build(ROBOT, "closed-form")
    rng = np.random.default_rng(0)
    with torch.no_grad():
        for name, weight in true.named_parameters():
            deviation = 0.1 if "inertial" in name else 0.3
            weight += deviation * torch.from_numpy(rng.normal(size=weight.shape))
    for chosen in (*((x,) for x in EFFECTS), tuple(EFFECTS)):
        name = " + ".join(chosen) if len(chosen) < 2 else "all"
        logs = [recorded(true, chosen, seed, noise=0.02) for seed in (1, 2)]
        yield name, logs, recorded(true, chosen, 9)


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


def of_the_urdf(urdf: Path, arm: Chain) -> Torque:
    """The URDF as it is, with the settings' drives where there are any."""
    names = [x.name for x in arm.coordinates]
    dynamics = urdf_dynamics(urdf, names, drives=drives_known(urdf, names))
    return torque_of(dynamics)


def best_ridge(arm: Chain, training: Sequence[DynamicsSamples]) -> Torque:
    """Least squares with the penalty that meets held-out blocks best."""
    seen, held = ([part(x, out) for x in training] for out in (False, True))

    def missed(size: float) -> float:
        return mean(ridge(arm, seen, size), held)

    return ridge(arm, training, min(RIDGES, key=missed))


def part(x: DynamicsSamples, out: bool) -> DynamicsSamples:
    """The samples of one trajectory that are held out, or the others."""
    rows = held_out(len(x.q)) == out
    return DynamicsSamples(x.name, *(column[rows] for column in (x.q, x.qd, x.qdd, x.tau)))


def held_out(count: int) -> np.ndarray:
    """Every fifth of blocks of time, for samples beside one another are alike."""
    return np.arange(count) * 10 // count % 5 == 4


def network(training: Sequence[DynamicsSamples], beside: Torque | None = None) -> Torque:
    """A network of q, qd and qdd, fitted to torques, or to what another predictor leaves of them."""
    inputs = [np.concatenate([s.q, s.qd, s.qdd], axis=-1) for s in training]
    moved, scale = np.concatenate(inputs).mean(0), np.concatenate(inputs).std(0) + 1e-9
    known = [0 * s.tau if beside is None else beside(s) for s in training]
    torch.manual_seed(0)
    layers = mlp(len(moved), training[0].q.shape[1], nn.Tanh)

    def model(q: Tensor, qd: Tensor, qdd: Tensor) -> Tensor:
        x = (torch.cat([q, qd, qdd], dim=-1) - torch.from_numpy(moved)) / torch.from_numpy(scale)
        return layers(x)

    learned = fitted(model, layers, training, [s.tau - k for s, k in zip(training, known, strict=True)])
    if beside is None:
        return learned
    return lambda x: learned(x) + beside(x)


class DeepLagrangian(nn.Module):
    """M = L L^T + a little, and V, by networks of cos q and sin q; friction of each joint beside them."""

    def __init__(self, joints: int) -> None:
        super().__init__()
        rows, columns = torch.tril_indices(joints, joints)
        places = torch.eye(joints * joints).double()[rows * joints + columns]  # of the entries of L
        self.places = places.unflatten(-1, (joints, joints))
        self.factor = mlp(2 * joints, joints * (joints + 1) // 2, nn.Softplus)
        self.potential = mlp(2 * joints, 1, nn.Softplus)
        self.viscous, self.coulomb = (nn.Parameter(torch.zeros(joints).double()) for _ in range(2))

    def mass(self, q: Tensor) -> Tensor:
        entries = self.factor(torch.cat([q.cos(), q.sin()], dim=-1))
        lower = torch.tensordot(entries, self.places, dims=1)
        return lower @ lower.mT + 1e-3 * torch.eye(q.shape[-1]).double()

    def forward(self, q: Tensor, qd: Tensor, qdd: Tensor) -> Tensor:
        def lagrangian(x: Tensor) -> Tensor:
            kinetic = 0.5 * torch.einsum("...i,...ij,...j->...", qd, self.mass(x), qd)
            return (kinetic - self.potential(torch.cat([x.cos(), x.sin()], dim=-1))[..., 0]).sum()

        change = jvp(lambda x: torch.einsum("...ij,...j->...i", self.mass(x), qd), (q,), (qd,))[1]
        inertia = torch.einsum("...ij,...j->...i", self.mass(q), qdd)
        friction = self.viscous * qd + self.coulomb * torch.tanh(qd / SMOOTHING)
        return inertia + change - grad(lagrangian)(q) + friction


def deep_lagrangian(training: Sequence[DynamicsSamples]) -> Torque:
    torch.manual_seed(0)
    model = DeepLagrangian(training[0].q.shape[1])
    return fitted(model, model, training, [s.tau for s in training])


def mlp(inputs: int, outputs: int, activation: type[nn.Module]) -> nn.Sequential:
    layers = [nn.Linear(inputs, WIDTH), activation(), nn.Linear(WIDTH, WIDTH), activation()]
    return nn.Sequential(*layers, nn.Linear(WIDTH, outputs)).double()


def fitted(
    model: Callable[..., Tensor],
    weights: nn.Module,
    training: Sequence[DynamicsSamples],
    torques: Sequence[np.ndarray],
) -> Torque:
    """The model, whose weights these are, fitted to torques in units of their deviations by AdamW, and stopped."""
    states = [np.concatenate([getattr(s, k) for s in training]) for k in ("q", "qd", "qdd")]
    y = np.concatenate(torques)
    moved, scale = y.mean(0), y.std(0) + 1e-9
    out = held_out(len(y))
    seen, held = ([torch.from_numpy(x[rows]) for x in (*states, (y - moved) / scale)] for rows in (~out, out))
    optimizer = torch.optim.AdamW(weights.parameters(), lr=1e-3)
    best, kept, waits = np.inf, weights.state_dict(), 0
    for _ in range(EPOCHS):
        for batch in torch.randperm(len(seen[0])).split(BATCH):
            optimizer.zero_grad()
            *given, target = (x[batch] for x in seen)
            (model(*given) - target).square().mean().backward()
            optimizer.step()
        with torch.no_grad():
            loss = float((model(*held[:3]) - held[3]).square().mean())
        waits = 0 if loss < best else waits + 1
        if loss < best:
            best, kept = loss, {name: value.clone() for name, value in weights.state_dict().items()}
        if waits > PATIENCE:
            break
    weights.load_state_dict(kept)

    def torque(x: DynamicsSamples) -> np.ndarray:
        with torch.no_grad():
            return model(*map(torch.from_numpy, (x.q, x.qd, x.qdd))).numpy() * scale + moved

    return torque


if __name__ == "__main__":
    main()
