"""Forward simulation of a model, tests of the model's physical consistency, and the error of the model's M.

The tests are on positive definiteness of M, and on the energy of free motion. The error of M needs the true M, which is
known for simulated arms only.
"""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from spelgen.arm.configured_arm import Arm, load_arm
from spelgen.dynamics.protocol import RigidDynamics, integrable
from spelgen.emission.assemble import ArmModel
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


def smallest_eigenvalue(model: ArmModel, low: Tensor, high: Tensor) -> float:
    """Return the smallest eigenvalue of M over random positions, divided by the mean eigenvalue over them.

    The positions are in [low, high] (n,) [rad, m]. The result is positive if M is positive definite at all positions.
    """
    # The seed of the random positions is fixed, so that the result is reproducible.
    generator = torch.Generator().manual_seed(0)
    count = TUNING.sampled_positions
    q = low + (high - low) * torch.rand(count, len(low), dtype=low.dtype, generator=generator)
    # M is computed for a tenth of the positions at a time: a batch of all would need gigabytes.
    chunks = q.chunk(10)
    eigenvalues = torch.cat([torch.linalg.eigvalsh(model.mass_matrix(chunk)) for chunk in chunks])
    return (eigenvalues.min() / eigenvalues.mean().abs()).item()


def energy_rise(model: ArmModel, windows: Windows) -> float | None:
    """Return the largest increase of the energy H in one step of 1 ms, divided by the largest kinetic energy.

    The motion is simulated without input, from the first states of the windows. For a passive model the energy does
    not increase, except for rounding. The result is None if the motion diverged or the kinetic energy is zero.
    """
    q, qd = windows.q[: TUNING.started_states, 0], windows.qd[: TUNING.started_states, 0]
    no_input = q.new_zeros(len(q), TUNING.free_steps, model.n)
    q, qd = rollout(model, q, qd, no_input, 1e-3)
    # The first state of each motion is omitted: it is measured, and only later states are computed by the model.
    q, qd = q[:, 1:], qd[:, 1:]
    energy = model.hamiltonian(q, model.momentum(q, qd))
    kinetic = (energy - model.potential_energy(q)).max().item()
    rise = energy.diff(dim=1).max().item()
    return rise / kinetic if kinetic > 0 and math.isfinite(rise / kinetic) else None


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
