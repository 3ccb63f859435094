"""Arms that position servos hold, rolled out under their commands.

Springs and dry friction are stiff, so both are taken implicitly, linearised at the start of a step (a Rosenbrock
method, Hairer and Wanner, Solving ODEs II, IV.7, with the weights of the theta method): a few steps between samples are
stable for any gain. Theta is such that motion which fades does so as fast as it would, to third order (Liniger and
Willoughby, SIAM J. Numerical Analysis 7:47, 1970): 1/2 for what is slow, which adds no damping of its own, and towards
1 for what is too fast for a step. Friction's memory follows the displacement exactly.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from spelgen.runtime.position_servo import beyond


class ServoDrives(NamedTuple):
    """What servos and friction do at joints: their constants, (..., n), and the laws that these belong to."""

    servo: Any
    laws: Any
    friction: Any
    offset: Tensor  # torque that the drives lack [Nm, N]


class ServoState(NamedTuple):
    """q and qd, (..., n), and friction's memory z, (..., n, K)."""

    q: Tensor
    qd: Tensor
    z: Tensor


class Load(NamedTuple):
    """What the bodies are to the drives.

    inertia: (..., n, n), or where not ``coupled`` (..., n), of each joint by itself. bias: the torque (..., n) that all
    but it takes. gravity: the part of it that gravity is.
    """

    inertia: Tensor
    bias: Tensor
    gravity: Tensor
    coupled: bool


def servo_drives(model: Any) -> ServoDrives:
    """Of a model with servos."""
    dynamics = model
    return ServoDrives(
        model.servo.prepare(), dynamics.friction, dynamics.friction.prepare(), dynamics.torque_offset
    )


def balanced(drives: ServoDrives, q: Tensor, qd: Tensor, u: Tensor, load: Load) -> ServoState:
    """The state whose friction makes up, as far as it can, for what the servos' torque is not: at rest, or steady."""
    servo, laws = drives.servo, drives.laws
    torque = (servo.kp * beyond(u - q, servo.dead_zone) - servo.kd * qd).clamp(
        -servo.limit, servo.limit
    ) - drives.offset
    rest = torque - load.bias - laws.viscosity(qd, drives.friction) * qd
    direction = (rest / laws.dry(qd, load.gravity, drives.friction)).clamp(-1.0, 1.0)
    return ServoState(q, qd, direction.unsqueeze(-1) * laws.bristles.reach)


def advanced(drives: ServoDrives, state: ServoState, u: Tensor, load: Load, h: Tensor) -> ServoState:
    """The state one step ``h`` (..., 1) [s] later, under the delayed command u (..., n)."""
    (q, qd, z), servo, laws = state, drives.servo, drives.laws
    reach, fractions = laws.bristles.reach, drives.friction.bristle_fractions
    dry = laws.dry(qd, load.gravity, drives.friction)
    bent = 1 - qd.sign().unsqueeze(-1) * z / reach  # of each bristle, what is left until it slides
    stiffness = dry * (fractions / reach * bent).sum(dim=-1)
    pull = servo.kp * beyond(u - q, servo.dead_zone)
    wanted = pull - servo.kd * qd
    free = (wanted.abs() < servo.limit).to(q)
    stiff = free * servo.kp * (pull != 0)
    torque = torch.where(free > 0, pull, servo.limit * wanted.sign())
    force = torque - drives.offset - load.bias - dry * (fractions / reach * z).sum(dim=-1)
    damping = free * servo.kd + laws.viscosity(qd, drives.friction)
    inertia = load.inertia.diagonal(dim1=-2, dim2=-1) if load.coupled else load.inertia
    fading = h * (damping + h * (stiff / 2 + stiffness)) / inertia
    theta = (3 + fading) / (6 + fading)
    # at theta of the step; bristles at its end: they are the stiffest
    damping = theta * h * (damping + h * (theta * stiff + stiffness))
    rest = theta * h * force
    if load.coupled:
        momentum = (load.inertia @ qd.unsqueeze(-1)).squeeze(-1)
        between = torch.linalg.solve(load.inertia + torch.diag_embed(damping), momentum + rest)
    else:
        between = (load.inertia * qd + rest) / (load.inertia + damping)
    moved = h * between
    return ServoState(q + moved, qd + (between - qd) / theta, laws.bristles.moved(z, moved))


def replayed(model: Any, q: Tensor, qd: Tensor, commands: Tensor, dt: Tensor) -> Tensor:
    """Positions (W, K, n) after each interval dt (W, K) [s], from q and qd (W, n), under delayed commands (W, K, S, n).

    S: steps in an interval, over which what the bodies weigh and how inert they are is taken once.
    """
    with torch.no_grad():
        drives, dynamics = servo_drives(model), model
        prepared, found = dynamics.prepare(), []
        state, before = None, None
        for now, held in zip(commands.unbind(1), dt.unbind(1), strict=True):
            at = dynamics.configuration(q, prepared)
            mass, residuals = dynamics.mass_at(at, prepared)
            bias = dynamics.nonlinear_at(at, qd, residuals, prepared)
            ahead = bias if before is None else bias + (bias - before) / 2  # of the interval's middle
            before = bias
            load = Load(mass, ahead, dynamics.gravity_at(at, prepared), coupled=True)
            state = balanced(drives, q, qd, now[:, 0], load) if state is None else state
            h = held.unsqueeze(-1) / now.shape[1]
            for u in now.unbind(1):
                state = advanced(drives, state, u, load, h)
            q, qd = state.q, state.qd
            found.append(q)
        return torch.stack(found, dim=1)
