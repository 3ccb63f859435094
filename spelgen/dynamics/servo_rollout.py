"""Roll out arms that position servos hold under their commands.

Springs and dry friction are stiff, so both are taken implicitly, springs linearised at the start of a step (Rosenbrock;
Hairer and Wanner, Solving ODEs II, IV.7, with the weights of the theta method): a few steps between samples are
stable for any gain. Theta is such that motion which fades does so as fast as it would, to third order (Liniger and
Willoughby, SIAM J. Numerical Analysis 7:47, 1970): 1/2 for what is slow, which adds no damping of its own, and towards
1 for what is too fast for a step. Friction's bristles follow the displacement exactly, also where they begin to slide.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from spelgen.dynamics.bristles import moved_bristles
from spelgen.runtime.friction_laws import FrictionConstants
from spelgen.runtime.port_hamiltonian import applied
from spelgen.runtime.position_servo import ServoConstants, beyond

COUPLED_PASSES = 2  # by which joints that move one another agree on which bristles slide
ServoArm = Any  # an emitted model with servos: emission comes after this room


class ServoDrives(NamedTuple):
    """Hold what servos and friction do at joints: their constants, (..., n).

    Bristles are (K, ..., n) here, so that numbers of an element lie side by side in memory: with (..., n, K) a step
    takes half as long again.
    """

    servo: ServoConstants
    friction: FrictionConstants
    offset: Tensor  # torque that the drives lack [Nm, N]
    reach: Tensor  # of bristles, (K, ..., n) [rad, m]
    steepness: Tensor  # of dry friction's direction by displacement, (K, ..., n) [1/rad, 1/m]


class ServoState(NamedTuple):
    """Hold q and qd, (..., n), and the state z of friction's bristles, (K, ..., n)."""

    q: Tensor
    qd: Tensor
    z: Tensor


class Load(NamedTuple):
    """Hold what the bodies are to the drives.

    inertia: (..., n, n), or where not ``coupled`` (..., n), of each joint by itself. bias: the torque (..., n) that all
    but it takes. gravity: the part of it that gravity is.
    """

    inertia: Tensor
    bias: Tensor
    gravity: Tensor
    coupled: bool


def servo_drives(model: ServoArm) -> ServoDrives:
    """Return those of a model with servos."""
    constants = model.friction.prepare()
    reach = constants.bristle_reach.T.contiguous()
    steepness = (constants.bristle_fractions / constants.bristle_reach).movedim(-1, 0).contiguous()
    batch = steepness.shape[1:-1] or (1,)  # of constants
    shape = len(reach), *[1] * len(batch), model.n
    steepness = steepness.reshape(len(reach), *batch, model.n)
    return ServoDrives(model.servo.prepare(), constants, model.torque_offset, reach.view(shape), steepness)


def balanced(drives: ServoDrives, q: Tensor, qd: Tensor, u: Tensor, load: Load) -> ServoState:
    """Return the state at rest, or of steady motion.

    Its friction makes up, as far as it can, for what the servos' torque is not.
    """
    servo = drives.servo
    torque = servo.kp * beyond(u - q, servo.dead_zone) - servo.kd * qd
    torque = torque.clamp(-servo.limit, servo.limit) - drives.offset
    excess = torque - load.bias - drives.friction.viscosity(qd) * qd
    direction = (excess / drives.friction.dry(qd, load.gravity)).clamp(-1.0, 1.0)
    return ServoState(q, qd, direction * drives.reach)


def advanced(drives: ServoDrives, state: ServoState, u: Tensor, load: Load, h: Tensor) -> ServoState:
    """Return the state one step ``h`` (..., 1) [s] later, under the delayed command u (..., n)."""
    (q, qd, z), servo = state, drives.servo
    strength = drives.friction.dry(qd, load.gravity) * drives.steepness
    spring = servo.kp * beyond(u - q, servo.dead_zone)
    torque = spring - servo.kd * qd
    free = (torque.abs() < servo.limit).to(q)  # 0 where the servo is saturated: it neither stiffens nor damps
    servo_stiffness = free * servo.kp * (spring != 0)
    torque = torch.where(free > 0, spring, servo.limit * torque.sign())
    force = torque - drives.offset - load.bias - (strength * z).sum(dim=0)
    damping = free * servo.kd + drives.friction.viscosity(qd)
    inertia = load.inertia.diagonal(dim1=-2, dim2=-1) if load.coupled else load.inertia
    stiffness = (strength * (qd.sign() * z < drives.reach)).sum(dim=0)
    decay = h * (damping + h * (servo_stiffness / 2 + stiffness)) / inertia
    theta = (3 + decay) / (6 + decay)
    # at theta of the step; bristles at its end: they are the stiffest
    impulse, bristle_stiffness = theta * h * force, theta * h * h * strength
    damping = theta * h * (damping + h * theta * servo_stiffness)
    # bristles by the velocity of the step, which is the unknown
    bent, reach = z / h, drives.reach / h
    velocity = slipped(inertia * qd + impulse, inertia + damping, bristle_stiffness, bent, reach)
    if load.coupled:
        momentum = applied(load.inertia, qd) + impulse
        # how far bristles give way depends on what other joints do
        for _ in range(COUPLED_PASSES):
            rise = (bristle_stiffness * (moved_bristles(bent, velocity, reach) - bent)).sum(dim=0)
            secant = rise / torch.where(velocity == 0, 1.0, velocity)
            effective = load.inertia + torch.diag_embed(damping + secant)
            velocity = torch.linalg.solve(effective, momentum.unsqueeze(-1)).squeeze(-1)
            others = applied(load.inertia, velocity) - inertia * velocity
            velocity = slipped(momentum - others, inertia + damping, bristle_stiffness, bent, reach)
    displacement = h * velocity
    qd = qd + (velocity - qd) / theta
    return ServoState(q + displacement, qd, moved_bristles(z, displacement, drives.reach))


def slipped(push: Tensor, slope: Tensor, strength: Tensor, z: Tensor, reach: Tensor) -> Tensor:
    """Return the displacement x, (..., n), at which slope x and the bristles' rise balance a push, (..., n).

    The rise is the sum of strength (z(x) - z). strength, z, reach: (K, ..., n), the shortest reach first. Bristles that
    are bent one way slide in that order, so x is the largest zero of K + 1 straight lines: in the k-th, k slide.
    """
    way, stiffness = push.sign(), slope + strength.sum(dim=0)
    # running sums: of what remains of the push, and of what resists, when k slide
    remaining = torch.cat([push.abs().unsqueeze(0), -strength * (reach - way * z)]).cumsum(dim=0)
    resisting = torch.cat([stiffness.unsqueeze(0), -strength]).cumsum(dim=0)
    return way * (remaining / resisting).amax(dim=0)


def replayed(model: ServoArm, q: Tensor, qd: Tensor, commands: Tensor, dt: Tensor) -> Tensor:
    """Return positions (W, K, n) after each interval dt (W, K) [s], from q and qd (W, n).

    Commands are delayed ones, (W, K, S, n). S: steps in an interval, over which what the bodies weigh and how inert
    they are is taken once.
    """
    with torch.no_grad():
        drives, prepared, positions = servo_drives(model), model.prepare(), []
        state, previous_bias = None, None
        for now, interval in zip(commands.unbind(1), dt.unbind(1), strict=True):
            pose = model.configuration(q, prepared)
            bias = middle_bias = model.nonlinear_effects(pose, qd)
            if previous_bias is not None:  # of the interval's middle
                middle_bias = bias + (bias - previous_bias) / 2
            previous_bias = bias
            load = Load(pose.mass, middle_bias, model.gravity(pose), coupled=True)
            if state is None:
                state = balanced(drives, q, qd, now[:, 0], load)
            h = interval.unsqueeze(-1) / now.shape[1]
            for u in now.unbind(1):
                state = advanced(drives, state, u, load, h)
            q, qd = state.q, state.qd
            positions.append(q)
        return torch.stack(positions, dim=1)
