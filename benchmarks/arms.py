"""Print tables of the errors of the presets `closed-form` and `hybrid`, and of other methods, per arm.

    python benchmarks/arms.py [FOLDER]

FOLDER is made by `python benchmarks/recordings.py FOLDER`, by default runs/recordings.

- Torques on recordings: nMSE, the mean squared error divided by the torque's variance, mean over joints, pauses
  included. The presets are fitted as by `spelgen train`. Least squares, ridge regression and the networks of
  `rivals.py` are fitted to the same filtered samples. `+ network` is a network for the residual of least squares.
- States predicted 0.1, 0.5 and 1 s ahead: RMS error divided by the RMS change of the state in this time. Predictors are
  constant velocity, and the model without and with a constant disturbance torque from a momentum observer.
- Torques of a simulated UR10e with a spring, gear ripple and friction that varies with position: nMSE.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).parent))
sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from leaderboard import cross_validated_ridge, folds
from motions import smooth_motion
from real_logs import (
    Torque,
    least_squares_torque,
    mean,
    samples_of,
    torque_of,
    trained,
)
from recordings import folder_of
from rivals import deep_lagrangian, network

import spelgen
from spelgen.arm.arm import Chain
from spelgen.arm.configured_arm import load_arm
from spelgen.dynamics.bristles import bristle_reach, bristles_along
from spelgen.dynamics.friction import FrictionModel
from spelgen.dynamics.pinocchio_dynamics import drives_known, urdf_dynamics
from spelgen.emission.build import build
from spelgen.fitting.torque.fit import fit_torque
from spelgen.labels import CONSTANT_VELOCITY, MODEL, observed
from spelgen.logs.dynamics_samples import DynamicsSamples
from spelgen.logs.trajectory import Trajectory

Split = tuple[str, Path, list[Trajectory], list[Trajectory]]

PRESETS = ("closed-form", "hybrid")


@dataclass(frozen=True)
class Case:
    """Training and test samples of an arm. models: per preset, the fitted model and the time of its fit [s]."""

    name: str
    urdf: Path
    training: list[DynamicsSamples]
    tests: list[DynamicsSamples]
    models: dict[str, tuple[Any, float]]


AHEAD = (0.1, 0.5, 1.0)  # [s] prediction horizons

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
            cross_validated_ridge(arm, training),
            plain,
            network(training, plain),
            least_squares_torque(arm, training, FrictionModel(memory=True)),
            *(torque_of(model) for model, _ in case.models.values()),
        ]
        errors = "".join(f"{mean(each, case.tests):12.5f}" for each in row)
        times = ", ".join(f"{seconds:.0f}" for _, seconds in case.models.values())
        print(f"{case.name:18}{errors}{times:>12}", flush=True)


def states_ahead(folder: Path) -> None:
    """Print the errors of states predicted `AHEAD` seconds ahead, as `spelgen evaluate` reports them, for each arm."""
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
    """Yield the documented splits of the recordings: name, URDF, training recordings and test recordings of an arm."""
    for fold in folds(folder):
        if "/split" in fold.name:
            tests = next(iter(fold.tests.values()))
            yield fold.name.removesuffix("/split"), fold.urdf, list(fold.training), list(tests)


def real(folder: Path) -> Iterator[Case]:
    """Yield a case per documented split of recordings: models of `PRESETS`, and filtered training and test samples.

    The splits into training and test recordings are described in docs/real_logs.md. Only test samples include pauses.
    """
    for name, urdf, training, tests in splits(folder):
        fits, models = {}, {}
        for preset in PRESETS:
            since = time.perf_counter()
            fits[preset] = trained(urdf, training, preset)
            models[preset] = fits[preset].model, time.perf_counter() - since
        fit = fits["closed-form"]
        yield Case(name, urdf, samples_of(fit, training), samples_of(fit, tests, pauses=True), models)


def simulated() -> Iterator[Case]:
    """Yield a case per effect of `EFFECTS`, and one with all effects, added to a simulated UR10e.

    The rigid bodies and friction of the simulated arm also differ from its URDF.
    """
    for name, logs, test in with_effects():
        models = {}
        for preset in PRESETS:
            model, since = build(ROBOT, preset), time.perf_counter()
            fit_torque(model, logs)
            models[preset] = model, time.perf_counter() - since
        yield Case(name, ROBOT, logs, [test], models)


def with_effects() -> Iterator[tuple[str, list[DynamicsSamples], DynamicsSamples]]:
    """Yield names of `EFFECTS`, and training and test samples of the simulated UR10e with these effects."""
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
    """Return samples of 30 s of a smooth random motion, with the torque of a model, of `effects`, and of noise.

    noise: standard deviation of the noise, relative to the standard deviation of each joint's torque.
    """
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
    """Return the torque function of the URDF's bodies, with the drives of the arm's settings if they state any."""
    names = [x.name for x in arm.coordinates]
    dynamics = urdf_dynamics(urdf, names, drives=drives_known(urdf, names))
    return torque_of(dynamics)


if __name__ == "__main__":
    main()
