"""Predictors of the motion of an arm under torques or position commands, and an integrator for stiff friction."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from spelgen.dynamics.equations import MotionEquations, equations_of
from spelgen.dynamics.protocol import RigidDynamics, is_stateful, memory_after, sliding_memory
from spelgen.logs.trajectory import LogRows
from spelgen.logs.windows import Windows, thinned
from spelgen.runtime.parts import applied
from spelgen.runtime.port_hamiltonian import PortHamiltonian

GAMMA = 1 - 0.5**0.5  # The Rosenbrock method is L-stable with this parameter.


State = tuple[Tensor, Tensor, Tensor]
"""Positions q [rad, m] and velocities qd [rad/s, m/s] of W windows, (W, n) each, and the friction state z of K
bristles per joint, (W, n, K) [rad, m]."""


def roll_out_stiff(
    dynamics: object, windows: Windows, substeps: int, disturbance: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Return predicted positions and velocities, (W, K-1, n) each, of W windows of K samples.

    Sample 0 of a window is the initial state; samples 1 to K-1 are predicted. If a prediction diverges, its later
    states are NaN.

    Method: ROS2, a Rosenbrock method. This method has order two for any approximation of the Jacobian, and is L-stable
    with the exact Jacobian (Verwer, Spee, Blom and Hundsdorfer, SIAM J. Sci. Comput. 20:1456, 1999). Here the
    approximation is the Jacobian of friction only. Stiff damping and bristles, which occur with light links and dry
    friction, then need no smaller steps. An explicit method would need smaller steps: its integration error could be
    confused with an error of the dynamics.

    Args:
        dynamics: dynamics of the arm, see `equations_of`.
        windows: measured motion (W, K, n) and inputs (W, K-1, n).
        substeps: number of integrator steps per sample interval.
        disturbance: constant disturbance in each window, (W, n), see `_stepper`; None: no disturbance.
    """
    q, qd = windows.q[:, 0], windows.qd[:, 0]
    # All predictors share the windows. Their initial friction state `windows.z` is only for dynamics with a friction
    # state; other dynamics get an empty state.
    z = windows.z if windows.z is not None and is_stateful(dynamics) else sliding_memory(dynamics, qd)
    largest = windows.qd.abs().amax(dim=(0, 1))
    largest = torch.maximum(largest, 1e-3 * largest.max()).clamp(min=1e-2)
    if disturbance is None:
        disturbance = torch.zeros_like(q)
    advance = _stepper(dynamics, TUNING.velocity_step * largest, disturbance)
    positions = torch.full_like(windows.q[:, 1:], torch.nan)
    velocities = positions.clone()
    for k in range(windows.dt.shape[1]):
        step = windows.dt[:, k].unsqueeze(-1) / substeps  # step: (W, 1) [s]
        for _ in range(substeps):
            q, qd, z = advance((q, qd, z), windows.tau[:, k], step)
        inside = ((qd.abs() <= TUNING.bounds * largest) & q.isfinite()).all(dim=-1, keepdim=True)
        if not inside.any():
            break
        # The state of a window that has diverged (velocity out of bounds, or not finite) becomes NaN. All later states
        # of the window are then NaN, too.
        q, qd = torch.where(inside, q, torch.nan), torch.where(inside, qd, torch.nan)
        positions[:, k], velocities[:, k] = q, qd
    return positions, velocities


def _stepper(
    dynamics: object, width: Tensor, disturbance: Tensor
) -> Callable[[State, Tensor, Tensor], State]:
    """Return a function that computes one integrator step of M qdd = force from (state, torque, step length).

    Args:
        dynamics: dynamics of the arm.
        width: finite-difference steps of velocity for the Jacobian of friction, (n,) [rad/s, m/s].
        disturbance: constant disturbance in W windows, (W, n): a force [Nm, N] if the state of the dynamics contains
            momenta, else an acceleration [rad/s^2, m/s^2].
    """
    pose_at = equations_of(dynamics)
    is_force = isinstance(dynamics, PortHamiltonian)

    def forces(pose: MotionEquations, qd: Tensor, tau: Tensor, z: Tensor) -> Tensor:
        """Return M qdd in W windows, (W, n) [Nm, N]: the sum of all forces, including the constant ``disturbance``.

        A disturbance that is an acceleration is multiplied by M. pose: mass matrix and forces at the positions q. qd:
        velocities, (W, n). tau: joint torques, (W, n). z: friction state.
        """
        added = disturbance if is_force else applied(pose.mass, disturbance)
        return pose.force(qd, tau, z) + added

    def step(state: State, tau: Tensor, step: Tensor) -> State:
        """Return the state after one step of the Rosenbrock method ROS2 (see `roll_out_stiff`) in W windows.

        The approximate Jacobian of (qd, qdd) with respect to (q, qd) is A = [[0, 1], [-M^-1 K, -M^-1 D]]. Friction
        opposes the motion: M qdd contains -friction. D >= 0 is the derivative of friction with respect to qd. If
        friction has a state z, which depends on q, K >= 0 is its derivative with respect to q; otherwise K = 0.

        state: q, qd, (W, n), and z. tau: torques, (W, n) [Nm, N]. step: (W, 1) [s].
        """
        q, qd, z = state
        pose = pose_at(q)
        damping, stiffness = _friction_slopes(dynamics, pose, qd, z, width)
        h = GAMMA * step
        # Both stages solve equations with the matrix 1 - h A, with h = GAMMA * step and the approximate Jacobian A of
        # (q, qd). After elimination of the position, the matrix is M + h D + h^2 K (n, n), which is factorised once for
        # both stages.
        factors, pivots, _ = torch.linalg.lu_factor_ex(
            pose.mass + torch.diag_embed(h * damping + h * h * stiffness)
        )

        def solve(velocity: Tensor, force: Tensor) -> tuple[Tensor, Tensor]:
            """Return the solution (v, a) of (1 - h A) (v, a) = (velocity, M^-1 force) in W windows, (W, n) each.

            A is the approximate Jacobian (see `step`), and h = GAMMA times the step length, with the parameter GAMMA of
            the Rosenbrock method. v and a are rates of q and qd.
            """
            right = (force - h * stiffness * velocity).unsqueeze(-1)
            solution = torch.linalg.lu_solve(factors, pivots, right).squeeze(-1)
            return velocity + h * solution, solution

        # Rosenbrock method of order 2 (ROS2 of Verwer et al., 1999) for u' = F(u), u = (q, qd), with the approximate
        # Jacobian A of F and h = GAMMA * step. The next state is u + step (3 k1 + k2) / 2, where (1 - h A) k1 = F(u)
        # and (1 - h A) k2 = F(u + step k1) - 2 k1.
        v1, a1 = solve(qd, forces(pose, qd, tau, z))
        q2, qd2 = q + step * v1, qd + step * a1
        second = pose_at(q2)
        force = forces(second, qd2, tau, memory_after(dynamics, z, q2 - q))
        # solve_ex raises no error, so that a singular matrix in one window does not stop the other windows.
        a2 = torch.linalg.solve_ex(second.mass, force)[0] - 2 * a1
        v2, a2 = solve(qd2 - 2 * v1, applied(pose.mass, a2))
        end = q + step * (1.5 * v1 + 0.5 * v2)
        speed = qd + step * (1.5 * a1 + 0.5 * a2)
        return end, speed, memory_after(dynamics, z, end - q)

    return step


def _friction_slopes(
    dynamics: object, pose: MotionEquations, qd: Tensor, z: Tensor, width: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the derivatives of joint friction with respect to velocity (damping) and to position (stiffness).

    Damping [Nm s/rad, N s/m] and stiffness [Nm/rad, N/m] are (W, n) for W windows, the diagonals of Jacobian matrices:
    the friction of a joint depends only on the motion of this joint. Bristles add the dependence on position.

    Args:
        dynamics: dynamics of the arm.
        pose: equations of motion at the current positions, with the function of friction.
        qd, z: velocities (W, n) [rad/s, m/s] and friction state (W, n, K) [rad, m] of K bristles.
        width: finite-difference steps of velocity, (n,) [rad/s, m/s].
    """
    # Central differences are used, because the slope of dry friction changes fast near standstill: their error is of
    # second order in `width`.
    slope = (pose.friction(qd + width, z) - pose.friction(qd - width, z)) / (2 * width)
    # Negative damping (friction that decreases with velocity) is omitted from the friction derivative D, so that the
    # matrix M + h D + h^2 K of a Rosenbrock step remains positive definite. The method then treats this part of
    # friction explicitly.
    damping = slope.clamp(min=0)
    if not z.shape[-1]:
        return damping, torch.zeros_like(damping)
    # The finite-difference step of position has the sign of the velocity, because the stiffness of a bristle differs
    # between further deflection and reversal.
    displacement = TUNING.displacement_step * torch.where(qd < 0, -1.0, 1.0).to(qd)
    bent = pose.friction(qd, memory_after(dynamics, z, displacement))
    return damping, ((bent - pose.friction(qd, z)) / displacement).clamp(min=0)


@dataclass(frozen=True)
class PredictorTuning:
    """Constants of the integration of predicted motion by the Rosenbrock method (`roll_out_stiff`)."""

    # [1] Largest number of integrator steps between two samples; a power of two.
    most_substeps: int = 16
    # [s] Shortest integrator step: only diverging dynamics would need shorter steps.
    shortest_step: float = 1e-3
    # [1] A number of steps is accepted if twice as many steps change the predicted velocities by less than this
    # fraction of their RMS error. With this value, the integration error changes the reported errors by about 0.1 %.
    tolerance: float = 5e-2
    # [1] Bound for models with nearly no error: in the criterion of `tolerance`, the RMS error is at least this number
    # times the RMS change of velocity in the windows. Without the bound, an exact model, whose RMS error is zero, would
    # need the largest number of steps.
    least_error: float = 2e-5
    # [1] Number of windows from which the number of integrator steps is chosen.
    probed_windows: int = 16
    # [1] A prediction has diverged if a velocity exceeds this multiple of the largest measured velocity.
    bounds: float = 100.0
    # [1] Finite-difference step of friction with respect to velocity, as a fraction of a joint's largest velocity.
    velocity_step: float = 1e-5
    # [rad, m] Finite-difference step of friction with respect to the displacement of bristles.
    displacement_step: float = 1e-7


TUNING = PredictorTuning()


States = tuple[Tensor, Tensor]


@dataclass(frozen=True, eq=False)
class Solver:
    """Integrator of predicted motion by the Rosenbrock method (`roll_out_stiff`).

    dynamics: the integrated dynamics. probe: measured windows from which the number of integrator steps per sample
    interval is chosen, see `substeps`.
    """

    dynamics: RigidDynamics
    probe: Windows

    def __call__(self, windows: Windows, disturbance: Tensor | None = None) -> States:
        """Return predicted q and qd at samples 1 to K-1 of W windows of K samples, (W, K-1, n) each.

        Values after a divergence are NaN. disturbance: constant force [Nm, N] or acceleration [rad/s^2, m/s^2] in each
        window, (W, n), see `_stepper`; None: zero.
        """
        return self._integrated(windows, self.substeps, disturbance)

    def _integrated(self, windows: Windows, substeps: int, disturbance: Tensor | None = None) -> States:
        with torch.no_grad(), np.errstate(over="ignore", invalid="ignore"):
            return roll_out_stiff(self.dynamics, windows, substeps, disturbance)

    @cached_property
    def substeps(self) -> int:
        """Number of integrator steps per sample interval; it is computed when motion is predicted for the first time.

        The number is doubled until a further doubling would change the predicted velocities of the `probe` windows by
        less than `TUNING.tolerance` times their RMS error.
        """
        windows = thinned(self.probe, TUNING.probed_windows)
        motion = (windows.qd - windows.qd[:, :1]).square().mean().sqrt().clamp(min=1e-9)
        substeps = 1
        coarse = self._integrated(windows, substeps)[1]
        # The step length has a lower bound, because no step length is accurate enough for dynamics that diverge.
        max_substeps = min(TUNING.most_substeps, windows.dt.mean().item() / TUNING.shortest_step)
        while 2 * substeps <= max_substeps:
            fine = self._integrated(windows, 2 * substeps)[1]
            error = (fine - windows.qd[:, 1:]).square().mean().sqrt()
            allowed = TUNING.tolerance * torch.maximum(TUNING.least_error * motion, error)
            if (fine - coarse).square().mean().sqrt() < allowed:
                break
            substeps, coarse = 2 * substeps, fine
        return substeps


Predictors = dict[str, Callable[[Windows], States]]
"""{name: predictor of the motion in windows from the first sample and the torques of each window}.

A predictor returns q and qd of W windows of K samples, (W, K-1, n) each, at all samples except the first. It is a
`Solver` if it integrates dynamics.
"""


class CommandFollower(Protocol):
    """Interface of predictors of joint positions under position commands."""

    def positions(self, segments: Sequence[LogRows], q: np.ndarray, qd: np.ndarray) -> list[np.ndarray]:
        """Return the predicted positions of each segment at the end of each sample interval.

        Args:
            segments: segments of logs; K is the number of sample intervals of a segment.
            q: (segments, n) initial positions [rad, m].
            qd: (segments, n) initial velocities [rad/s, m/s].

        Returns:
            One array of positions per segment, (K, n) [rad, m].
        """
