"""The error of the mass matrix, for simulated arms whose truth is known."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from torch import Tensor

from spelgen.arm.configured_arm import Arm, load_arm
from spelgen.dynamics.protocol import RigidDynamics
from spelgen.evaluation.tuning import TUNING


def true_mass(robot: Arm | Path | str, q: Tensor, joints: Sequence[str] | None = None) -> Tensor:
    """Return M (T, n, n) [kg m^2, kg m, kg] of a URDF and its settings by Pinocchio, armature included.

    Args:
        robot: The true arm, or the path of its URDF.
        q: Positions (T, n) [rad; m].
        joints: Names of the n joints in the order of q; None: from the settings, or the longest chain.
    """
    from spelgen.dynamics.pinocchio_arm import arm_dynamics

    path = robot.robot.path if isinstance(robot, Arm) else robot
    loaded = load_arm(path, joints)
    mass: Tensor = arm_dynamics(loaded.chain, loaded.settings).mass_matrix(q)
    return mass


def mass_error(learned: Tensor, true: Tensor) -> float:
    """Return the relative error of M, without unit: root mean square of the entries of L^-1 (learned - true) L^-T.

    L L^T is the mean of the true M, so each entry counts in the units of its own joints.

    Args:
        learned: M (T, n, n) of a model.
        true: M (T, n, n) of the arm.
    """
    factor = torch.linalg.cholesky(true.mean(dim=0))
    half = torch.linalg.solve_triangular(factor, learned - true, upper=False)
    relative = torch.linalg.solve_triangular(factor, half.mT, upper=False)
    return float(relative.square().mean().sqrt())


def mass_errors(
    dynamics: Mapping[str, RigidDynamics], truth: Arm | Path | str, joints: Sequence[str], q: Tensor
) -> dict[str, float]:
    """Return the relative error of M by predictor, at evenly spread positions.

    Args:
        dynamics: The model and the baselines, by name.
        truth: The true arm, or the path of its URDF.
        joints: Names of the n joints.
        q: Positions (T, n) [rad; m] of the test logs.
    """
    q = q[:: max(1, len(q) // TUNING.mass_positions)]
    true = true_mass(truth, q, joints)
    errors = {}
    for name, predictor in dynamics.items():
        with torch.no_grad():
            errors[name] = mass_error(torch.as_tensor(predictor.mass_matrix(q)), true)
    return errors
