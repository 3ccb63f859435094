"""Predictors of the motion of an arm, under torques or under position commands, and the integration of dynamics."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from spelgen.dynamics.equations import MotionEquations, equations_of
from spelgen.dynamics.protocol import RigidDynamics, is_stateful, memory_after, sliding_memory
from spelgen.logs.trajectory import LogRows
from spelgen.logs.windows import Windows, thinned
from spelgen.runtime.port_hamiltonian import PortHamiltonian

GAMMA = 1 - 0.5**0.5  # makes the method L-stable


State = tuple[Tensor, Tensor, Tensor]
"""q and qd, (W, n), and the friction state z, (W, n, K)."""


def roll_out_stiff(
    dynamics: object, windows: Windows, substeps: int, disturbance: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Return positions and velocities (W, K-1, n) at samples 1..K-1 of each window, from its sample 0.

    Method: ROS2, a Rosenbrock method of order two for any matrix in place of the Jacobian; with the exact one it is
    L-stable (Verwer, Spee, Blom and Hundsdorfer, SIAM J. Sci. Comput. 20:1456, 1999). Here the matrix is the Jacobian
    of friction only, so that damping and bristles of any stiffness (light links with dry friction) need no smaller
    steps, and the error of an explicit method is not confused with an error of the dynamics.

    disturbance: (W, n) of `observe`. After a divergence the states of a window are NaN.
    """
    q, qd = windows.q[:, 0], windows.qd[:, 0]
    z = sliding_memory(dynamics, qd) if windows.z is None else windows.z
    largest = windows.qd.abs().amax(dim=(0, 1))
    largest = torch.maximum(largest, 1e-3 * largest.max()).clamp(min=1e-2)
    if disturbance is None:
        disturbance = torch.zeros_like(q)
    advance = _stepper(dynamics, TUNING.velocity_step * largest, disturbance)
    positions = torch.full_like(windows.q[:, 1:], torch.nan)
    velocities = positions.clone()
    for k in range(windows.dt.shape[1]):
        step = windows.dt[:, k].unsqueeze(-1) / substeps  # (W, 1)
        for _ in range(substeps):
            q, qd, z = advance((q, qd, z), windows.tau[:, k], step)
        inside = ((qd.abs() <= TUNING.bounds * largest) & q.isfinite()).all(dim=-1, keepdim=True)
        if not inside.any():
            break
        # NaN propagates to all later samples
        q, qd = torch.where(inside, q, torch.nan), torch.where(inside, qd, torch.nan)
        positions[:, k], velocities[:, k] = q, qd
    return positions, velocities


def _stepper(
    dynamics: object, width: Tensor, disturbance: Tensor
) -> Callable[[State, Tensor, Tensor], State]:
    """Return the function that takes a step of M qdd = force from a state, under tau.

    width: (n,) finite-difference steps of velocity. disturbance: a force if the state has momenta, else acceleration.
    """
    pose_at = equations_of(dynamics)
    is_force = isinstance(dynamics, PortHamiltonian)

    def forces(pose: MotionEquations, qd: Tensor, tau: Tensor, z: Tensor) -> Tensor:
        """Return the generalized forces M qdd, (W, n) [Nm, N]; pose: the equations of motion at q."""
        added = disturbance if is_force else (pose.mass @ disturbance.unsqueeze(-1)).squeeze(-1)
        return pose.force(qd, tau, z) + added

    def step(state: State, tau: Tensor, step: Tensor) -> State:
        """Take one step of (q, qd), with A = [[0, 1], [-M^-1 K, -M^-1 D]].

        D = d friction / d qd and, if friction has a state z, K = d friction / d q through z.
        """
        q, qd, z = state
        pose = pose_at(q)
        damping, stiffness = _friction_slopes(dynamics, pose, qd, z, width)
        h = GAMMA * step
        # With the position eliminated the matrix is M + h D + h^2 K: one factorisation of size n serves both stages.
        factors, pivots, _ = torch.linalg.lu_factor_ex(
            pose.mass + torch.diag_embed(h * damping + h * h * stiffness)
        )

        def solve(velocity: Tensor, force: Tensor) -> tuple[Tensor, Tensor]:
            """Return (1 - h A)^-1 of (velocity, force), with the mass in the second row."""
            right = (force - h * stiffness * velocity).unsqueeze(-1)
            solution = torch.linalg.lu_solve(factors, pivots, right).squeeze(-1)
            return velocity + h * solution, solution

        # Result: u + step (3 k1 + k2) / 2 with (1 - h A) k1 = F(u), (1 - h A) k2 = F(u + step k1) - 2 k1.
        v1, a1 = solve(qd, forces(pose, qd, tau, z))
        q2, qd2 = q + step * v1, qd + step * a1
        second = pose_at(q2)
        force = forces(second, qd2, tau, memory_after(dynamics, z, q2 - q))
        # solve_ex: a singular matrix of one window must not stop the others
        a2 = torch.linalg.solve_ex(second.mass, force)[0] - 2 * a1
        v2, a2 = solve(qd2 - 2 * v1, (pose.mass @ a2.unsqueeze(-1)).squeeze(-1))
        end = q + step * (1.5 * v1 + 0.5 * v2)
        speed = qd + step * (1.5 * a1 + 0.5 * a2)
        return end, speed, memory_after(dynamics, z, end - q)

    return step


def _friction_slopes(
    dynamics: object, pose: MotionEquations, qd: Tensor, z: Tensor, width: Tensor
) -> tuple[Tensor, Tensor]:
    """Return D and K, (W, n): the friction of a joint depends on its own motion only."""
    # central differences: dry friction jumps at standstill
    slope = (pose.friction(qd + width, z) - pose.friction(qd - width, z)) / (2 * width)
    # friction that falls with velocity (negative damping) is integrated by the explicit part
    damping = slope.clamp(min=0)
    if not is_stateful(dynamics):
        return damping, torch.zeros_like(damping)
    # bristles deflect in the direction of motion
    displacement = TUNING.displacement_step * torch.where(qd < 0, -1.0, 1.0).to(qd)
    bent = pose.friction(qd, memory_after(dynamics, z, displacement))
    return damping, ((bent - pose.friction(qd, z)) / displacement).clamp(min=0)


@dataclass(frozen=True)
class PredictorTuning:
    """Integration of predictions by the Rosenbrock method."""

    # [1] Largest number of steps between samples; a power of two.
    most_substeps: int = 16
    # [s] Shortest step: only dynamics that diverge would need shorter ones.
    shortest_step: float = 1e-3
    # [1] Allowed change of a result if the steps are doubled, relative to the error of the dynamics: reported figures
    # change by a thousandth.
    tolerance: float = 5e-2
    # [1] Smallest expected error of dynamics, relative to the motion.
    least_error: float = 2e-5
    # [1] Windows on which the number of steps is chosen.
    probed_windows: int = 16
    # [1] Multiple of the largest measured velocity beyond which a prediction has diverged.
    bounds: float = 100.0
    # [1] Finite-difference step of friction with respect to velocity, as a fraction of a joint's largest velocity.
    velocity_step: float = 1e-5
    # [rad, m] Finite-difference step of friction with respect to the displacement of bristles.
    displacement_step: float = 1e-7


TUNING = PredictorTuning()


States = tuple[Tensor, Tensor]


@dataclass(frozen=True)
class Solver:
    """The Rosenbrock method, with `substeps` steps per sample interval."""

    dynamics: RigidDynamics
    substeps: int

    def __call__(self, windows: Windows, disturbance: Tensor | None = None) -> States:
        """Return predicted q and qd, (W, K-1, n); NaN if they diverged. disturbance: see `roll_out_stiff`."""
        with torch.no_grad(), np.errstate(over="ignore", invalid="ignore"):
            return roll_out_stiff(self.dynamics, windows, self.substeps, disturbance)


def accurate_solver(dynamics: RigidDynamics, probe: Windows) -> Solver:
    """Return the solver with the fewest steps per sample interval that suffice: twice as many change little."""
    windows = thinned(probe, TUNING.probed_windows)
    motion = (windows.qd - windows.qd[:, :1]).square().mean().sqrt().clamp(min=1e-9)
    solver = Solver(dynamics, 1)
    coarse = solver(windows)[1]
    # only dynamics that diverge would need shorter steps, and cannot be predicted with them either
    max_substeps = min(TUNING.most_substeps, windows.dt.mean().item() / TUNING.shortest_step)
    while 2 * solver.substeps <= max_substeps:
        finer = replace(solver, substeps=2 * solver.substeps)
        fine = finer(windows)[1]
        error = (fine - windows.qd[:, 1:]).square().mean().sqrt()
        allowed = TUNING.tolerance * torch.maximum(TUNING.least_error * motion, error)
        if (fine - coarse).square().mean().sqrt() < allowed:
            break
        solver, coarse = finer, fine
    return solver


@dataclass(frozen=True)
class Predictor:
    """A predictor of windows of K samples: q and qd, both (W, K-1, n), from the first sample and the torques.

    solver: a `Solver` if there are dynamics, else any function. dynamics: None if the prediction needs none.
    """

    name: str
    solver: Callable[[Windows], States]
    dynamics: RigidDynamics | None = None


def of_dynamics(name: str, dynamics: RigidDynamics, probe: Windows) -> Predictor:
    """Return the predictor of `dynamics`, with the number of integration steps chosen on the probe windows."""
    return Predictor(name, accurate_solver(dynamics, probe), dynamics)


class CommandFollower(Protocol):
    """Predictor of positions under position commands. about: its name and the method of its fit."""

    @property
    def about(self) -> str: ...

    def positions(self, parts: Sequence[LogRows], q: np.ndarray, qd: np.ndarray) -> list[np.ndarray]:
        """Return the positions at the end of each sample interval.

        Args:
            parts: rows of logs, each with K sample intervals.
            q: (parts, n) initial positions [rad, m].
            qd: (parts, n) initial velocities [rad/s, m/s].

        Returns:
            (K, n) [rad, m] for each part.
        """
