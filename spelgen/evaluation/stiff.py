"""Rollouts of dynamics that are not the model's, accurate whatever steps the model needs.

Where friction is stiff (light links against a jump of dry friction) by ROS2 (Verwer, Spee, Blom and Hundsdorfer, SIAM
J. Sci. Comput. 20:1456, 1999): a Rosenbrock method of order two for any matrix in place of the Jacobian, L-stable
where that is the exact one. Here it is that of friction alone, so that damping of any size asks for no smaller steps,
and what an explicit method would make of it is not taken for an error of the dynamics.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
import torch

from spelgen.dynamics.protocol import RigidDynamics, integrable
from spelgen.fitting.rollout import roll_out
from spelgen.logs.windows import Windows

STEPS = (1, 2, 4, 8, 16)  # between samples
EXPLICIT, IMPLICIT = 2e-3, 2e-2  # of the dynamics' own error, what twice as many steps may change
PROBED = 16  # windows
SHORTEST = 1e-3  # s: shorter steps are for dynamics that leave all bounds
GAMMA = 1 - 0.5**0.5
VELOCITY = 1e-5  # of a joint's largest velocity, that friction is differentiated by


Solver = Callable[[Windows], tuple[torch.Tensor, torch.Tensor]]


def accurate_solver(dynamics: RigidDynamics, probe: Windows) -> Solver:
    """What predicts windows by these dynamics, accurately on the probe: RK4 where some steps between samples do, and
    where none do the method above.
    """
    form = integrable(dynamics)

    def explicit(windows: Windows, steps: int) -> tuple[torch.Tensor, torch.Tensor]:
        return roll_out(form, windows, steps)

    def implicit(windows: Windows, steps: int) -> tuple[torch.Tensor, torch.Tensor]:
        return roll_out_stiff(dynamics, windows, steps)

    some = probe[:: -(-len(probe) // PROBED)]
    allowed = [steps for steps in STEPS if steps == 1 or some.dt.mean() / steps >= SHORTEST]
    for method, tolerance in ((explicit, EXPLICIT), (implicit, IMPLICIT)):
        steps = _steps(method, some, tolerance, allowed)
        if steps is not None:
            return partial(_quietly, method, steps)
    return partial(_quietly, implicit, allowed[-1])


def _steps(
    method: Callable[..., Any], probe: Windows, tolerance: float, allowed: Sequence[int]
) -> int | None:
    """The fewest steps between samples that twice as many agree with."""
    motion = (probe.qd - probe.qd[:, :1]).square().mean().sqrt().clamp(min=1e-9)
    try:
        coarse = _quietly(method, allowed[0], probe)[1]
        for steps in allowed:
            fine = _quietly(method, 2 * steps, probe)[1]
            error = (fine - probe.qd[:, 1:]).square().mean().sqrt()
            if (fine - coarse).square().mean().sqrt() < tolerance * torch.maximum(0.1 * motion, error):
                return steps
            coarse = fine
    except torch.linalg.LinAlgError:  # numbers blew up
        pass
    return None


def _quietly(
    method: Callable[..., tuple[torch.Tensor, torch.Tensor]], steps: int, windows: Windows
) -> tuple[torch.Tensor, torch.Tensor]:
    """Dynamics that leave all bounds are bad, and no error here."""
    with torch.no_grad(), np.errstate(over="ignore", invalid="ignore"):
        return method(windows, steps)


def roll_out_stiff(
    dynamics: RigidDynamics, windows: Windows, substeps: int
) -> tuple[torch.Tensor, torch.Tensor]:
    """Positions and velocities (W, K-1, n) predicted for samples 1..K-1 of each window from its sample 0."""
    q, qd = windows.q[:, 0], windows.qd[:, 0]
    positions, velocities = [], []
    with (
        torch.no_grad(),
        np.errstate(over="ignore", invalid="ignore"),
    ):  # what leaves all bounds is no error here
        for dt, tau in zip(windows.dt.unbind(1), windows.tau.unbind(1), strict=True):
            step = dt.unsqueeze(-1) / substeps  # (W, 1)
            for _ in range(substeps):
                q, qd = _step(dynamics, q, qd, tau, step)
            positions.append(q)
            velocities.append(qd)
    return torch.stack(positions, dim=1), torch.stack(velocities, dim=1)


def _step(
    dynamics: RigidDynamics, q: torch.Tensor, qd: torch.Tensor, tau: torch.Tensor, step: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """One step of ROS2 for (q, qd), with A = [[0, 1], [0, -M^-1 D]] and D = d friction / d qd."""
    mass = torch.as_tensor(dynamics.mass_matrix(q))
    width = VELOCITY * qd.abs().amax(dim=0).clamp(min=1e-3)
    rise = dynamics.friction_torque(q, qd + width) - dynamics.friction_torque(q, qd - width)
    damping = (rise / (2 * width)).clamp(min=0)  # (W, n): a joint's friction goes by its own velocity
    h = GAMMA * step
    matrix = mass + torch.diag_embed(h * damping)

    def solve(velocity: torch.Tensor, acceleration: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """(1 - h A)^-1 of a state's two halves."""
        force = (mass @ acceleration.unsqueeze(-1)).squeeze(-1)
        solved, info = torch.linalg.solve_ex(matrix, force)
        return velocity + h * solved, torch.where(info.unsqueeze(-1) == 0, solved, torch.nan)

    v1, a1 = solve(qd, torch.as_tensor(dynamics.forward_dynamics(q, qd, tau)))
    q2, qd2 = q + step * v1, qd + step * a1
    v2, a2 = solve(qd2 - 2 * v1, torch.as_tensor(dynamics.forward_dynamics(q2, qd2, tau)) - 2 * a1)
    return q + step * (1.5 * v1 + 0.5 * v2), qd + step * (1.5 * a1 + 0.5 * a2)
