"""Forward simulation of a model, and the error of its mass matrix M.

The error of M needs the true M, which is known for simulated arms only.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from spelgen.arm.configured_arm import Arm, load_arm
from spelgen.dynamics.protocol import RigidDynamics, integrable
from spelgen.evaluation.tuning import TUNING
from spelgen.fitting.rollout import roll_out
from spelgen.logs.windows import Windows
from spelgen.settings.fits import Solver


def rollout(
    model: RigidDynamics,
    q: Tensor,
    qd: Tensor,
    tau: Tensor,
    dt: float | Tensor,
    solver: Solver = "rk4",
    substeps: int = 1,
) -> tuple[Tensor, Tensor]:
    """Integrate the motion of a model under torques that are constant in each interval.

    Args:
        model: emitted model, or any other dynamics of an arm with n joints.
        q: (..., n) initial positions [rad, m].
        qd: (..., n) initial velocities [rad/s, m/s].
        tau: (..., T, n) torques of the T intervals [Nm, N].
        dt: length of the intervals [s]: a number, or (..., T) for intervals of different length.
        solver: ``rk4``: classical Runge-Kutta; ``dopri5``: adaptive steps of torchdiffeq.
        substeps: number of steps of rk4 per interval.

    Returns:
        Positions [rad, m] and velocities [rad/s, m/s], each (..., T + 1, n), the initial state included.
    """
    q, qd, tau = map(torch.as_tensor, (q, qd, tau))
    batch = np.broadcast_shapes(q.shape[:-1], tau.shape[:-2])
    samples, n = tau.shape[-2:]
    steps = torch.as_tensor(dt, dtype=q.dtype, device=q.device).expand(*batch, samples)
    q, qd = (x.expand(*batch, n).reshape(-1, 1, n) for x in (q, qd))
    inputs = tau.expand(*batch, samples, n).reshape(-1, samples, n)
    windows = Windows(steps.reshape(-1, samples), q, qd, inputs)
    positions, velocities = roll_out(integrable(model), windows, substeps, solver)
    shape = (*batch, samples + 1, n)
    positions = torch.cat([q, positions], dim=1).reshape(shape)
    return positions, torch.cat([qd, velocities], dim=1).reshape(shape)


def true_mass(robot: Arm | Path | str, q: Tensor, joints: Sequence[str] | None = None) -> Tensor:
    """Return M (T, n, n) [kg m^2, kg m, kg] by Pinocchio, from a URDF and the settings file of the same name.

    Args:
        robot: The true arm, or the path of its URDF. Its settings contain the armatures, which are included in M.
        q: Positions (T, n) [rad, m].
        joints: Names of the n joints in the order of q; None: the joints in the settings, else the longest chain.
    """
    from spelgen.dynamics.pinocchio_arm import arm_dynamics

    path = robot.robot.path if isinstance(robot, Arm) else robot
    loaded = load_arm(path, joints)
    mass: Tensor = arm_dynamics(loaded.chain, loaded.settings).mass_matrix(q)
    return mass


def mass_error(learned: Tensor, true: Tensor) -> float:
    """Return the dimensionless error of M: the root mean square of the entries of L^-1 (learned - true) L^-T.

    L is the Cholesky factor of the mean true M. It scales each entry by the inertia of the joints of the entry.

    Args:
        learned: M (T, n, n) of a model.
        true: M (T, n, n) of the arm.
    """
    # All errors are scaled with the mean of the true M. With M at each position as the scale, the errors at positions
    # at which M is nearly singular would dominate.
    factor = torch.linalg.cholesky(true.mean(dim=0))
    half = torch.linalg.solve_triangular(factor, learned - true, upper=False)
    relative = torch.linalg.solve_triangular(factor, half.mT, upper=False)
    return float(relative.square().mean().sqrt())


def mass_errors(
    dynamics: Mapping[str, RigidDynamics], truth: Arm | Path | str, joints: Sequence[str], q: Tensor
) -> dict[str, float]:
    """Return {predictor: relative error of M, see `mass_error`}, at a subset of the test positions.

    Args:
        dynamics: {name of the model or of a baseline: dynamics}.
        truth: The true arm, or the path of its URDF.
        joints: Names of the n joints.
        q: Positions (T, n) [rad, m] of the test logs.
    """
    # Positions are subsampled: M changes slowly along a trajectory, so more positions give the same error.
    q = q[:: max(1, len(q) // TUNING.mass_positions)]
    true = true_mass(truth, q, joints)
    with torch.no_grad():
        learned = {name: torch.as_tensor(x.mass_matrix(q)) for name, x in dynamics.items()}
    return {name: mass_error(mass, true) for name, mass in learned.items()}
