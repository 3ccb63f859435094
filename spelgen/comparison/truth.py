"""What a simulated robot truly is, to judge what was learned: its mass matrix along measured positions."""

from __future__ import annotations

from pathlib import Path

import torch

from spelgen.loaded_arm import load_arm


def true_mass(robot: Path, q: torch.Tensor) -> torch.Tensor:
    """Return M (T, n, n) [kg m^2, kg m, kg] of a URDF and its sidecar, by Pinocchio, at q (T, n); rotors included."""
    from spelgen.dynamics.pinocchio_arm import arm_dynamics

    loaded = load_arm(robot)
    mass: torch.Tensor = arm_dynamics(loaded.arm, loaded.settings).mass_matrix(q)
    return mass


def mass_error(learned: torch.Tensor, true: torch.Tensor) -> float:
    """Return how far M is off (T, n, n), without unit: root mean square of the entries of L^-1 (learned - true) L^-T.

    L L^T is the mean true M: so every entry counts in the units of its own joints.
    """
    factor = torch.linalg.cholesky(true.mean(dim=0))
    half = torch.linalg.solve_triangular(factor, learned - true, upper=False)
    relative = torch.linalg.solve_triangular(factor, half.mT, upper=False)
    return float(relative.square().mean().sqrt())
