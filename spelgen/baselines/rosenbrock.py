"""Rollouts of dynamics with stiff friction, by ROS2 (Verwer, Spee, Blom and Hundsdorfer, SIAM J. Sci. Comput. 20:1456,
1999): a Rosenbrock method of order two for any matrix in place of the Jacobian, L-stable where that is the exact one.

Here the matrix is the Jacobian of friction alone, so that damping and bristles of any stiffness (light links against a
jump of dry friction) ask for no smaller steps, and what an explicit method would make of it is not taken for an error
of the dynamics.
"""

from __future__ import annotations

import torch
from torch import Tensor

from spelgen.dynamics.protocol import (
    VelocityState,
    has_friction_state,
    known_past,
    memory_after,
    sliding_memory,
)
from spelgen.logs.windows import Windows

GAMMA = 1 - 0.5**0.5  # makes the method L-stable
# steps of the differences that friction is differentiated by
VELOCITY_STEP = 1e-5  # of a joint's largest velocity
DISPLACEMENT_STEP = 1e-7  # rad, m


def roll_out_stiff(form: VelocityState, windows: Windows, substeps: int) -> tuple[Tensor, Tensor]:
    """Return positions and velocities (W, K-1, n) predicted for samples 1..K-1 of each window from its sample 0."""
    q, qd = windows.q[:, 0], windows.qd[:, 0]
    z = sliding_memory(form.dynamics, qd) if windows.z is None else windows.z
    positions, velocities = [], []
    for dt, tau in zip(windows.dt.unbind(1), windows.tau.unbind(1), strict=True):
        step = dt.unsqueeze(-1) / substeps  # (W, 1)
        for _ in range(substeps):
            start = q
            q, qd = _step(form, q, qd, z, tau, step)
            z = memory_after(form.dynamics, z, q - start)
        positions.append(q)
        velocities.append(qd)
    return torch.stack(positions, dim=1), torch.stack(velocities, dim=1)


def _step(
    form: VelocityState, q: Tensor, qd: Tensor, z: Tensor, tau: Tensor, step: Tensor
) -> tuple[Tensor, Tensor]:
    """Take one step of (q, qd), with A = [[0, 1], [-M^-1 K, -M^-1 D]], D = d friction / d qd and, where friction has
    a state, K = d friction / d q by the way z follows.
    """
    dynamics = form.dynamics
    mass = torch.as_tensor(dynamics.mass_matrix(q))
    damping, stiffness = _friction_slopes(form, q, qd, z)
    h = GAMMA * step
    matrix = mass + torch.diag_embed(h * damping + h * h * stiffness)

    def solve(velocity: Tensor, acceleration: Tensor) -> tuple[Tensor, Tensor]:
        """Return (1 - h A)^-1 of a state's two halves."""
        force = (mass @ acceleration.unsqueeze(-1)).squeeze(-1) - h * stiffness * velocity
        solution, info = torch.linalg.solve_ex(matrix, force)
        # one singular matrix must not stop the other windows
        solution = torch.where(info.unsqueeze(-1) == 0, solution, torch.nan)
        return velocity + h * solution, solution

    def acceleration(position: Tensor, velocity: Tensor) -> Tensor:
        past = memory_after(dynamics, z, position - q)
        return form.port_hamiltonian_rhs(position, velocity, tau, None, past)[1]

    v1, a1 = solve(qd, acceleration(q, qd))
    q2, qd2 = q + step * v1, qd + step * a1
    v2, a2 = solve(qd2 - 2 * v1, acceleration(q2, qd2) - 2 * a1)
    return q + step * (1.5 * v1 + 0.5 * v2), qd + step * (1.5 * a1 + 0.5 * a2)


def _friction_slopes(form: VelocityState, q: Tensor, qd: Tensor, z: Tensor) -> tuple[Tensor, Tensor]:
    """Return D and K, (W, n): a joint's friction goes by its own motion."""
    dynamics = form.dynamics

    def friction(velocity: Tensor, displacement: Tensor) -> Tensor:
        past = known_past(dynamics, memory_after(dynamics, z, displacement))
        return torch.as_tensor(dynamics.friction_torque(q, velocity, *past))

    still = torch.zeros_like(q)
    # central differences: dry friction jumps at standstill
    width = VELOCITY_STEP * qd.abs().amax(dim=0).clamp(min=1e-3)
    # friction that falls with velocity is left to the explicit part: its damping would be negative
    slope = (friction(qd + width, still) - friction(qd - width, still)) / (2 * width)
    damping = slope.clamp(min=0)
    if not has_friction_state(dynamics):
        return damping, torch.zeros_like(damping)
    # bristles load the way a joint goes
    way = DISPLACEMENT_STEP * torch.where(qd < 0, -1.0, 1.0).to(q)
    return damping, ((friction(qd, way) - friction(qd, still)) / way).clamp(min=0)
