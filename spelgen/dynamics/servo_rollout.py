"""Rollouts of arms with position servos: positions under logged commands, by an implicit integration method.

Servos act as springs, kp times the position error. These springs and dry friction are stiff. Both are integrated
implicitly, so that a few steps between samples are stable for any kp. Springs are nonlinear (dead zone, torque limit),
and are linearised at the start of a step (Rosenbrock method with the weights of the theta method; Hairer and Wanner,
Solving ODEs II, IV.7). Theta = (3 + x) / (6 + x) is computed for each step: x is the duration of the step divided by
the time constant with which the velocity decays. Theta is 1/2 for slow motion, without numerical damping, and tends to
1 for motion that is too fast for the step. The computed decay is then exact to third order in x (exponential fitting;
Liniger and Willoughby, SIAM J. Numerical Analysis 7:47, 1970). The friction state is not integrated, but computed from
the displacement in the step. Its shape is (K, ..., n) for K bristles per joint.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from spelgen.dynamics.bristles import moved_bristles
from spelgen.dynamics.prepared import State
from spelgen.runtime.friction_laws import FrictionConstants
from spelgen.runtime.motors import ServoConstants, beyond
from spelgen.runtime.parts import applied
from spelgen.runtime.port_hamiltonian import PortHamiltonian
from spelgen.runtime.rigid_body_dynamics import RigidBodyDynamics


class ServoDrives(NamedTuple):
    """Constants of an arm's drives for the rollouts of this module: servos, friction, torque offsets and bristles.

    The last dimension of each constant has the n drives; dimensions before it, if any, are batch dimensions. The
    friction of a drive is a parallel connection of K bristles: `reach` and `steepness` have one value per bristle in
    the first dimension, (K, ..., n). With this layout, a rollout takes two thirds of the time that it takes with (...,
    n, K).
    """

    servo: ServoConstants
    friction: FrictionConstants
    offset: Tensor  # torque offset [Nm, N]
    reach: Tensor  # break-away displacements, (K, ..., n) [rad, m]
    steepness: Tensor  # stiffness of a bristle / magnitude of dry friction, (K, ..., n) [1/rad, 1/m]


class Load(NamedTuple):
    """Inertia and torques of the rigid bodies, which are constant during a step.

    Attributes:
        inertia: mass matrix M, (..., n, n), if ``coupled``; otherwise only its diagonal, (..., n), so that joints are
            independent.
        bias: Coriolis, centrifugal and gravity torque, (..., n) [Nm, N].
        gravity: gravity torque, on which dry friction depends, (..., n) [Nm, N].
        coupled: True if the inertia couples the joints.
    """

    inertia: Tensor
    bias: Tensor
    gravity: Tensor
    coupled: bool


def servo_drives(model: PortHamiltonian) -> ServoDrives:
    """Return the constants of servos and friction of a model whose inputs are commands of position servos."""
    assert isinstance(model, RigidBodyDynamics) and model.servo is not None
    constants = model.friction.prepare()
    reach = constants.bristle_reach.T.contiguous()
    steepness = (constants.bristle_fractions / constants.bristle_reach).movedim(-1, 0).contiguous()
    # Constants of K bristles of n drives are (K, *batch, n), with the batch dimensions of the friction constants.
    # Without batch dimensions, one of size 1 is added, (K, 1, n), so that the constants broadcast with states of W
    # windows, (K, W, n).
    batch = steepness.shape[1:-1] or (1,)
    shape = len(reach), *[1] * len(batch), model.n
    steepness = steepness.reshape(len(reach), *batch, model.n)
    return ServoDrives(model.servo.prepare(), constants, model.torque_offset, reach.view(shape), steepness)


def balanced(drives: ServoDrives, q: Tensor, qd: Tensor, u: Tensor, load: Load) -> State:
    """Return the initial state of a rollout: q, qd, and the friction state that balances all other torques.

    The acceleration is then zero, as for an arm at rest or in steady motion. All bristles of a joint are deflected by
    the same fraction of their break-away displacements. If the other torques exceed the largest dry friction, the
    fraction is 1 and the acceleration is not zero.

    Args:
        drives: constants of servos and friction.
        q: positions, (..., n) [rad, m].
        qd: velocities, (..., n) [rad/s, m/s].
        u: delayed commands, (..., n) [rad, m].
        load: torques of the rigid bodies at q and qd.
    """
    servo = drives.servo
    torque = servo.kp * beyond(u - q, servo.dead_zone) - servo.kd * qd
    torque = torque.clamp(-servo.limit, servo.limit) - drives.offset
    excess = torque - load.bias - drives.friction.viscosity(qd) * qd
    direction = (excess / drives.friction.dry(qd, load.gravity)).clamp(-1.0, 1.0)
    return State(q, qd, direction * drives.reach)


def advanced(drives: ServoDrives, state: State, u: Tensor, load: Load, h: Tensor) -> State:
    """Return the state after one implicit step (see the module's docstring).

    Args:
        drives: constants of servos and friction.
        state: state at the start of the step.
        u: delayed commands during the step, (..., n) [rad, m].
        load: inertia and torques of the rigid bodies during the step.
        h: duration of the step, (..., 1) [s].
    """
    (q, qd, z), servo = state, drives.servo
    strength = drives.friction.dry(qd, load.gravity) * drives.steepness
    spring = servo.kp * beyond(u - q, servo.dead_zone)
    torque = spring - servo.kd * qd
    # `free` is 0 if the servo is saturated: its torque is then constant, without stiffness and damping.
    within = torque.abs() < servo.limit
    free = within.to(q)
    servo_stiffness = free * servo.kp * (spring != 0)
    torque = torch.where(within, spring, servo.limit * torque.sign())
    force = torque - drives.offset - load.bias - (strength * z).sum(dim=0)
    damping = free * servo.kd + drives.friction.viscosity(qd)
    inertia = load.inertia.diagonal(dim1=-2, dim2=-1) if load.coupled else load.inertia
    stiffness = (strength * (qd.sign() * z < drives.reach)).sum(dim=0)
    decay = h * (damping + h * (servo_stiffness / 2 + stiffness)) / inertia
    theta = (3 + decay) / (6 + decay)
    # The springs of the servos are evaluated after the fraction theta of the step; the bristles, which are stiffer, at
    # the end of the step.
    part = theta * h
    impulse, bristle_stiffness = part * force, part * h * strength
    damping = part * (damping + part * servo_stiffness)
    # The unknown of the equation is the mean velocity of the step, so displacements are divided by the duration h.
    bent, reach = z / h, drives.reach / h
    velocity = slipped(inertia * qd + impulse, inertia + damping, bristle_stiffness, bent, reach)
    if load.coupled:
        momentum = applied(load.inertia, qd) + impulse
        # The inertia couples the joints, so the sliding bristles of one joint depend on the motion of all joints. The
        # mean velocity of the step is found by two fixed-point iterations. Each iteration solves the coupled equations
        # with the bristles as linear springs: `rise` is their change of force, and `secant` is `rise` divided by the
        # velocity.
        for _ in range(2):
            rise = (bristle_stiffness * (moved_bristles(bent, velocity, reach) - bent)).sum(dim=0)
            secant = rise / torch.where(velocity == 0, 1.0, velocity)
            effective = load.inertia + torch.diag_embed(damping + secant)
            velocity = torch.linalg.solve(effective, momentum.unsqueeze(-1)).squeeze(-1)
            coupling = applied(load.inertia, velocity) - inertia * velocity
            velocity = slipped(momentum - coupling, inertia + damping, bristle_stiffness, bent, reach)
    displacement = h * velocity
    qd = qd + (velocity - qd) / theta
    return State(q + displacement, qd, moved_bristles(z, displacement, drives.reach))


def slipped(push: Tensor, slope: Tensor, strength: Tensor, z: Tensor, reach: Tensor) -> Tensor:
    """Return the displacement x of each joint that balances a force against a spring and K bristles, (..., n).

    x solves slope x + sum_k strength_k (z_k(x) - z_k) = push, where z_k(x) = clip(z_k + x, -reach_k, reach_k) is the
    deflection of bristle k after the displacement x. For a given number of sliding bristles, 0 to K, the equation is
    linear in x. Of the K + 1 solutions, the one with the largest |x| is valid. Reason: the force of a bristle is the
    smaller of two, its elastic force, which increases with |x|, and its constant sliding force. An equation with a
    wrong set of sliding bristles uses the larger of the two for some bristle. Its resistance is then too large, and its
    |x| too small.

    Args:
        push: force on the joint, (..., n). Units are any consistent ones: in `advanced`, push is a momentum, slope an
            inertia and x a velocity.
        slope: stiffness of the spring, without bristles, (..., n).
        strength, z, reach: stiffness, initial deflection and break-away displacement of each bristle, (K, ..., n), the
            shortest break-away displacement first: bristles begin to slide in this order.
    """
    direction, stiffness = push.sign(), slope + strength.sum(dim=0)
    # The linear equations for 0 to K sliding bristles are solved by cumulative sums. The displacement |x| of each
    # solution is `remaining` (|push| minus the forces of the sliding bristles) divided by `resisting` (the stiffness
    # `slope` plus the stiffness of the bristles that do not slide). The largest |x| is valid, see the docstring.
    remaining = torch.cat([push.abs().unsqueeze(0), -strength * (reach - direction * z)]).cumsum(dim=0)
    resisting = torch.cat([stiffness.unsqueeze(0), -strength]).cumsum(dim=0)
    return direction * (remaining / resisting).amax(dim=0)


def replayed(model: PortHamiltonian, q: Tensor, qd: Tensor, commands: Tensor, dt: Tensor) -> Tensor:
    """Integrate the motion of W windows (intervals of a log) under their commands; return positions, (W, I, n).

    A window has I sampling intervals, each of S integration steps. Positions are returned at the end of each sampling
    interval [rad, m]. M and the gravity torque are evaluated once per sampling interval.

    Args:
        model: model with position servos.
        q, qd: initial positions [rad, m] and velocities [rad/s, m/s] of the windows, (W, n).
        commands: delayed commands of each step, (W, I, S, n) [rad, m].
        dt: durations of the sampling intervals, (W, I) [s].
    """
    with torch.no_grad():
        drives, prepared, positions = servo_drives(model), model.prepare(), []
        state, previous_bias = None, None
        for now, interval in zip(commands.unbind(1), dt.unbind(1), strict=True):
            pose = model.configuration(q, prepared)
            # M and gravity are evaluated once per interval, since they change slowly, unlike springs and friction.
            bias = middle_bias = model.nonlinear_effects(pose, qd)
            # The bias (Coriolis, centrifugal and gravity torque) is known up to the start of the interval, and is
            # extrapolated to its middle.
            if previous_bias is not None:
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
