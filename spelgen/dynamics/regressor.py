"""The rigid-body regressor Y(q, qd, qdd): the joint torques are Y times the bodies' inertial parameters.

Newton-Euler in body frames (Khalil and Dombre, Modeling, Identification and Control of Robots, 2002, ch. 9 and 12).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations_with_replacement

import numpy as np

from spelgen.arm.arm import Arm, Body


def _cross_table() -> np.ndarray:
    """Return the table, (3, 3, 3), that is @ b applied to a, summed over the last axes, a x b."""
    table = np.zeros((3, 3, 3))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        table[i, j, k], table[i, k, j] = 1.0, -1.0
    return table


def _tensor_table() -> np.ndarray:
    """Return a symmetric tensor's entries by its six components, (3, 3, 6)."""
    table = np.zeros((3, 3, 6))
    for component, (i, j) in enumerate(combinations_with_replacement(range(3), 2)):
        table[i, j, component] = table[j, i, component] = 1.0
    return table


_CROSS, _TENSOR = _cross_table(), _tensor_table()


@dataclass(frozen=True, eq=False)
class _State:
    """How a body's frame stands in its parent's and moves, T samples, in its own axes.

    acceleration: of the origin, less gravity.
    """

    rotation: np.ndarray  # (T, 3, 3)
    position: np.ndarray  # (T, 3)
    velocity: np.ndarray  # (T, 3) angular
    angular: np.ndarray  # (T, 3) angular acceleration
    acceleration: np.ndarray  # (T, 3)


def regressor(arm: Arm, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
    """Y (T, n, 10 B) at q, qd, qdd, each (T, n), of the arm's B bodies: tau = Y pi [Nm, N].

    Column 10 b + i belongs to parameter i of ``arm.bodies[b]``, in the order of ``Body.inertia``.
    """
    states: list[_State] = []
    result = np.zeros((*q.shape, 10 * len(arm.bodies)))
    for index, body in enumerate(arm.bodies):
        states.append(_moved(arm, body, states, q, qd, qdd))
        force, moment = _wrench(states[index])
        columns = result[:, :, 10 * index : 10 * index + 10]
        carrier = index
        while carrier >= 0:
            link = arm.bodies[carrier]
            along = moment if link.kind == "revolute" else force
            columns[:, link.coordinate] += float(link.multiplier) * along[:, 2]
            state = states[carrier]
            force, moment = state.rotation @ force, state.rotation @ moment
            moment = moment + _crossing(state.position) @ force
            carrier = link.parent
    return result


def urdf_parameters(arm: Arm) -> np.ndarray:
    """The URDF's own inertial parameters, (10 B,); zero for a body without."""
    return np.array([body.inertia or (0,) * 10 for body in arm.bodies], dtype=float).ravel()


def _moved(
    arm: Arm, body: Body, states: list[_State], q: np.ndarray, qd: np.ndarray, qdd: np.ndarray
) -> _State:
    factor = float(body.multiplier)
    value = factor * q[:, body.coordinate] + body.offset
    speed, rise = (factor * x[:, body.coordinate, None] for x in (qd, qdd))
    pose = np.array(body.rotation, dtype=float)
    position = np.broadcast_to(np.array(body.translation, dtype=float), (len(q), 3))
    axis = np.array([0.0, 0.0, 1.0])
    if body.kind == "revolute":
        rotation = pose @ _turn(value)
    else:
        rotation = np.broadcast_to(pose, (len(q), 3, 3))
        position = position + value[:, None] * pose[:, 2]
    if body.parent < 0:
        velocity = angular = np.zeros((len(q), 3))
        acceleration = np.broadcast_to(-np.array(arm.gravity, dtype=float), (len(q), 3))
    else:
        parent = states[body.parent]
        velocity, angular = parent.velocity, parent.angular
        swing = np.cross(velocity, np.cross(velocity, position))
        acceleration = parent.acceleration + np.cross(angular, position) + swing
    velocity, angular, acceleration = (
        np.einsum("tij,ti->tj", rotation, x) for x in (velocity, angular, acceleration)
    )
    if body.kind == "revolute":
        angular = angular + rise * axis + speed * np.cross(velocity, axis)
        velocity = velocity + speed * axis
    else:
        acceleration = acceleration + rise * axis + 2 * speed * np.cross(velocity, axis)
    return _State(rotation, position, velocity, angular, acceleration)


def _turn(angle: np.ndarray) -> np.ndarray:
    """Rotations about z, (T, 3, 3)."""
    c, s = np.cos(angle), np.sin(angle)
    zero, one = np.zeros_like(c), np.ones_like(c)
    return np.stack([c, -s, zero, s, c, zero, zero, zero, one], axis=-1).reshape(-1, 3, 3)


def _wrench(state: _State) -> tuple[np.ndarray, np.ndarray]:
    """Force and moment about the origin by the body's ten parameters, each (T, 3, 10)."""
    samples = len(state.velocity)
    spin = _crossing(state.velocity)
    inertia = np.einsum("ijc,tj->tic", _TENSOR, state.angular)
    inertia = inertia + spin @ np.einsum("ijc,tj->tic", _TENSOR, state.velocity)
    force, moment = np.zeros((2, samples, 3, 10))
    force[:, :, 0] = state.acceleration
    force[:, :, 1:4] = _crossing(state.angular) + spin @ spin
    moment[:, :, 1:4] = -_crossing(state.acceleration)
    moment[:, :, 4:] = inertia
    return force, moment


def _crossing(vector: np.ndarray) -> np.ndarray:
    """[a]x with [a]x b = a x b, (T, 3, 3)."""
    result: np.ndarray = np.einsum("ikj,tk->tij", _CROSS, vector)
    return result
