"""How much data a model needs, and how much a URDF is worth: torque error by preset, seconds of motion and URDF.

    python benchmarks/learning_curves.py [ROBOT ...]

The arms are robots/rpr.urdf and robots/six_dof.urdf by default, with friction and rotors other than their settings
say. Torques have noise of 2 % of their deviation. The URDF that models start from is the true one, one whose bodies are
30 % wrong (see `spelgen compare --urdf-error`), or one of placeholders: every link 1 kg, a ball of 10 cm about its
frame. What needs no inertials has one row: least squares, with and without friction's memory, and networks of the
derived structure (minimal, spel) and without any (phnode), fitted to the same torques. nMSE on a minute of other
motion, mean of the joints; the median of three draws of motion and noise.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).parent))
sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from lxml import etree
from motions import smooth_motion
from real_logs import mean, torque_of

from spelgen.building import build
from spelgen.comparison.known_urdf import with_wrong_inertials
from spelgen.dynamics.bristles import bristle_reach, bristles_along
from spelgen.fitting.torque_fit import fit_torque
from spelgen.fitting.torque_networks import fit_networks
from spelgen.identification.friction import FrictionModel
from spelgen.identification.identify import least_squares
from spelgen.identification.method import LeastSquares
from spelgen.loaded_arm import load_arm
from spelgen.logs.dynamics_samples import DynamicsSamples

ROBOTS = Path(__file__).parents[1] / "robots"
SECONDS = (2.0, 20.0, 200.0)
NOISE = 0.02  # of a torque's deviation
DRAWS = 3
EVALUATIONS = 500  # of networks
BALL = 0.4 * 0.1**2  # kg m2
Torque = Callable[..., np.ndarray]


def main() -> None:
    torch.set_num_threads(1)
    for robot in sys.argv[1:] or [str(ROBOTS / "rpr.urdf"), str(ROBOTS / "six_dof.urdf")]:
        curves(Path(robot))


def curves(robot: Path) -> None:
    true = truth(robot)
    tests = [recorded(true, 60.0, seed=100, noise=0.0)]
    arm = load_arm(robot).arm
    print(f"\n{robot.stem}\n{'':34}" + "".join(f"{f'{x:g} s':>12}" for x in SECONDS), flush=True)
    with tempfile.TemporaryDirectory() as folder:
        urdfs = {
            name: Path(folder) / f"{name.replace(' ', '_')}.urdf"
            for name in ("true", "30 % wrong", "placeholders")
        }
        urdfs["true"].write_bytes(with_wrong_inertials(robot, 0.0))
        urdfs["30 % wrong"].write_bytes(with_wrong_inertials(robot, 0.3))
        urdfs["placeholders"].write_bytes(with_placeholders(robot))
        for preset in ("closed-form", "hybrid"):
            for name, urdf in urdfs.items():
                row(f"{preset}, URDF {name}", lambda x, u=urdf, p=preset: rigid(u, p, x), true, tests)
    plain, memory = LeastSquares("range"), LeastSquares("range", friction=FrictionModel(memory=True))
    row("least squares", lambda x: least_squares(arm, x, plain).torque, true, tests)
    row("least squares with memory", lambda x: least_squares(arm, x, memory).torque, true, tests)
    for preset in ("minimal", "spel", "phnode"):
        row(f"{preset}, networks", lambda x, p=preset: networks(robot, p, x), true, tests)


def row(
    name: str, fitted: Callable[[list[DynamicsSamples]], Torque], true: Any, tests: Sequence[DynamicsSamples]
) -> None:
    errors = [
        np.median([mean(fitted([recorded(true, x, seed, NOISE)]), tests) for seed in range(DRAWS)])
        for x in SECONDS
    ]
    print(f"{name:34}" + "".join(f"{x:12.1e}" for x in errors), flush=True)


def truth(robot: Path) -> Any:
    """The arm: bodies of the URDF, friction and rotors near its settings."""
    model = build(robot, "closed-form")
    rng = np.random.default_rng(0)
    with torch.no_grad():
        for name, weight in model.named_parameters():
            if "inertial" not in name:
                weight += 0.3 * torch.from_numpy(rng.normal(size=weight.shape))
    return model


def recorded(model: Any, seconds: float, seed: int, noise: float) -> DynamicsSamples:
    """A smooth random motion with the model's torque; noise by the torque's deviation."""
    rng = np.random.default_rng(seed)
    q, qd, qdd = smooth_motion(model.n, seconds, rng)
    z = bristles_along(q, bristle_reach(model))
    with torch.no_grad():
        tau = model.inverse_dynamics(*map(torch.from_numpy, (q, qd, qdd, z))).numpy()
    tau += noise * tau.std(axis=0) * rng.normal(size=tau.shape)
    return DynamicsSamples("simulated", q, qd, qdd, tau, z)


def with_placeholders(robot: Path) -> bytes:
    """The URDF with the same body at every link that has one."""
    tree = etree.fromstring(with_wrong_inertials(robot, 0.0))
    for inertial in tree.iterfind(".//link/inertial"):
        for child in list(inertial):
            inertial.remove(child)
        etree.SubElement(inertial, "mass", value="1")
        moments = {
            name: str(BALL if name in ("ixx", "iyy", "izz") else 0.0)
            for name in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
        }
        etree.SubElement(inertial, "inertia", **moments)
    return etree.tostring(tree)


def rigid(urdf: Path, preset: str, samples: list[DynamicsSamples]) -> Torque:
    model = build(urdf, preset)
    fit_torque(model, samples)
    return torque_of(model)


def networks(urdf: Path, preset: str, samples: list[DynamicsSamples]) -> Torque:
    model = build(urdf, preset)
    fit_networks(model, samples, evaluations=EVALUATIONS)
    return torque_of(model)


if __name__ == "__main__":
    main()
