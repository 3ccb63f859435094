"""Largest random parameters with which M is positive definite and accelerations are finite in single precision.

    python benchmarks/float32.py

All parameters of an emitted model are random normal numbers with mean zero and one standard deviation, from 1 to 1000.
For each robot, preset and standard deviation there are 8 random models, each evaluated at 300 random states.
"""

from __future__ import annotations

from pathlib import Path

import torch

import spelgen
from spelgen.design import PRESET_NAMES

ROBOTS = Path(__file__).parents[1] / "robots"
DEVIATIONS = (1, 3, 10, 30, 100, 300, 1000)
DRAWS, STATES = 8, 300


def main() -> None:
    """Print per robot and preset the largest standard deviation of the parameters without a failure.

    M is positive definite and accelerations are finite (`holds`) in all random models with this or a smaller one of
    `DEVIATIONS`.
    """
    for robot in ("two_link", "rpr", "six_dof"):
        for preset in PRESET_NAMES:
            source = spelgen.generate(ROBOTS / f"{robot}.urdf", preset, width=16, depth=1)
            kept = 0
            for deviation in DEVIATIONS:
                if not all(holds(source, deviation, draw) for draw in range(DRAWS)):
                    break
                kept = deviation
            print(f"{robot:9} {preset:12} holds up to {kept}", flush=True)


def holds(source: str, deviation: float, seed: int) -> bool:
    """Return True if M is positive definite and qdd finite in single precision, at `STATES` random states.

    source: text of an emitted module. deviation: standard deviation of its parameters. seed: of all random numbers.
    """
    generator = torch.Generator().manual_seed(seed)
    model = spelgen.load_module(source)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.copy_(
                deviation * torch.randn(parameter.shape, generator=generator, dtype=torch.float64)
            )
        model = model.float()
        q, qd, tau = (torch.randn(STATES, model.n, generator=generator) for _ in range(3))
        try:
            failed = torch.linalg.cholesky_ex(model.mass_matrix(2 * q))[1].any()
            return bool(~failed & model.forward_dynamics(2 * q, qd, tau).isfinite().all())
        except torch.linalg.LinAlgError:
            return False


if __name__ == "__main__":
    main()
