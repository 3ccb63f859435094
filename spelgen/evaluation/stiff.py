"""Rollouts of dynamics that are not the model's, accurate whatever steps the model needs.

Where friction is stiff (light links against a jump of dry friction) by ROS2 (Verwer, Spee, Blom and Hundsdorfer, SIAM
J. Sci. Comput. 20:1456, 1999): a Rosenbrock method of order two for any matrix in place of the Jacobian, L-stable
where that is the exact one. Here it is that of friction alone, so that damping and bristles of any stiffness ask for no
smaller steps, and what an explicit method would make of it is not taken for an error of the dynamics.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from spelgen.dynamics.protocol import (
    RigidDynamics,
    VelocityState,
    has_friction_state,
    integrable,
    known_past,
    memory_after,
    sliding_memory,
)
from spelgen.evaluation.momentum_observer import Disturbed
from spelgen.fitting.rollout import roll_out
from spelgen.logs.windows import Windows

STEPS = (1, 2, 4, 8, 16)  # between samples
EXPLICIT, IMPLICIT = 2e-3, 2e-2  # of the dynamics' own error, what twice as many steps may change
PROBED = 16  # windows
SHORTEST = 1e-3  # s: shorter steps are for dynamics that leave all bounds
GAMMA = 1 - 0.5**0.5
VELOCITY = 1e-5  # of a joint's largest velocity, that friction is differentiated by
DISPLACEMENT = 1e-7  # rad, m, likewise


States = tuple[torch.Tensor, torch.Tensor]


@dataclass(frozen=True)
class Solver:
    """Predict windows. form: what is integrated, see `integrable`. method: `roll_out` or `roll_out_stiff`."""

    form: Any
    method: Callable[[Any, Windows, int], States]
    substeps: int

    def __call__(self, windows: Windows, disturbance: torch.Tensor | None = None) -> States:
        """Return q and qd, (W, K-1, n); under a disturbance (W, n) that is added to p'.

        Leaving all bounds is no error: a window whose numbers blow up is NaN.
        """
        try:
            return self._rolled_out(windows, disturbance)
        except torch.linalg.LinAlgError:
            if len(windows) == 1:
                nowhere = torch.full_like(windows.q[:, 1:], torch.nan)
                return nowhere, nowhere
        halves = []
        for rows in torch.arange(len(windows)).tensor_split(2):
            halves.append(self(windows[rows], None if disturbance is None else disturbance[rows]))
        (q, qd), (other_q, other_qd) = halves
        return torch.cat([q, other_q]), torch.cat([qd, other_qd])

    def _rolled_out(self, windows: Windows, disturbance: torch.Tensor | None) -> States:
        form = self.form if disturbance is None else Disturbed(self.form, disturbance)
        with torch.no_grad(), np.errstate(over="ignore", invalid="ignore"):
            return self.method(form, windows, self.substeps)


def accurate_solver(dynamics: RigidDynamics, probe: Windows) -> Solver:
    """What predicts windows by these dynamics, accurately on the probe: RK4 where some steps between samples do, and
    where none do the method above.
    """
    explicit, implicit = (integrable(dynamics), roll_out), (VelocityState(dynamics), roll_out_stiff)
    some = probe[:: -(-len(probe) // PROBED)]
    allowed = [steps for steps in STEPS if steps == 1 or some.dt.mean() / steps >= SHORTEST]
    for (form, method), tolerance in ((explicit, EXPLICIT), (implicit, IMPLICIT)):
        steps = _steps(form, method, some, tolerance, allowed)
        if steps is not None:
            return Solver(form, method, steps)
    return Solver(*implicit, allowed[-1])


def _steps(
    form: Any,
    method: Callable[[Any, Windows, int], States],
    probe: Windows,
    tolerance: float,
    allowed: Sequence[int],
) -> int | None:
    """The fewest steps between samples that twice as many agree with."""
    motion = (probe.qd - probe.qd[:, :1]).square().mean().sqrt().clamp(min=1e-9)
    try:
        coarse = Solver(form, method, allowed[0])(probe)[1]
        for steps in allowed:
            fine = Solver(form, method, 2 * steps)(probe)[1]
            error = (fine - probe.qd[:, 1:]).square().mean().sqrt()
            if (fine - coarse).square().mean().sqrt() < tolerance * torch.maximum(0.1 * motion, error):
                return steps
            coarse = fine
    except torch.linalg.LinAlgError:  # numbers blew up
        pass
    return None


def roll_out_stiff(form: Any, windows: Windows, substeps: int) -> States:
    """Positions and velocities (W, K-1, n) predicted for samples 1..K-1 of each window from its sample 0, by dynamics
    in velocities (see `VelocityState`).
    """
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
    form: Any, q: torch.Tensor, qd: torch.Tensor, z: torch.Tensor, tau: torch.Tensor, step: torch.Tensor
) -> States:
    """One step of ROS2 for (q, qd), with A = [[0, 1], [-M^-1 K, -M^-1 D]], D = d friction / d qd and, where friction
    remembers, K = d friction / d q by the way z follows.
    """
    dynamics = form.dynamics
    mass = torch.as_tensor(dynamics.mass_matrix(q))

    def friction(speed: torch.Tensor, moved: torch.Tensor | float = 0.0) -> torch.Tensor:
        past = known_past(dynamics, memory_after(dynamics, z, moved + torch.zeros_like(q)))
        return torch.as_tensor(dynamics.friction_torque(q, speed, *past))

    width = VELOCITY * qd.abs().amax(dim=0).clamp(min=1e-3)
    damping = ((friction(qd + width) - friction(qd - width)) / (2 * width)).clamp(min=0)
    stiffness = torch.zeros_like(damping)  # (W, n), as damping: a joint's friction goes by its own motion
    if has_friction_state(dynamics):
        way = DISPLACEMENT * torch.where(qd < 0, -1.0, 1.0).to(q)
        stiffness = ((friction(qd, way) - friction(qd)) / way).clamp(min=0)
    h = GAMMA * step
    matrix = mass + torch.diag_embed(h * damping + h * h * stiffness)

    def solve(velocity: torch.Tensor, acceleration: torch.Tensor) -> States:
        """(1 - h A)^-1 of a state's two halves."""
        force = (mass @ acceleration.unsqueeze(-1)).squeeze(-1) - h * stiffness * velocity
        solved, info = torch.linalg.solve_ex(matrix, force)
        solved = torch.where(info.unsqueeze(-1) == 0, solved, torch.nan)
        return velocity + h * solved, solved

    def rhs(at: torch.Tensor, speed: torch.Tensor) -> torch.Tensor:
        found: torch.Tensor = form.port_hamiltonian_rhs(
            at, speed, tau, None, memory_after(dynamics, z, at - q)
        )[1]
        return found

    v1, a1 = solve(qd, rhs(q, qd))
    q2, qd2 = q + step * v1, qd + step * a1
    v2, a2 = solve(qd2 - 2 * v1, rhs(q2, qd2) - 2 * a1)
    return q + step * (1.5 * v1 + 0.5 * v2), qd + step * (1.5 * a1 + 0.5 * a2)
