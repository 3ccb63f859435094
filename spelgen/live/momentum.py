"""Terms of the momentum balance of an arm and of a payload at its last body, at measured states.

The generalised momentum p = M qd of the arm, and P theta of a payload with the ten inertial parameters theta, obey

    d/dt (p + P theta) = G (tau - offset) + dL/dq - friction + N theta + external torque,

with L the Lagrangian (De Luca and Mattone, ICRA 2005): no acceleration is needed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from spelgen.dynamics.protocol import is_stateful
from spelgen.runtime.rigid_body_dynamics import RigidBodyDynamics

_BLOCK = 2048  # samples that are computed at a time


class Balance(NamedTuple):
    """Terms of the momentum balance at samples, (T, n) or (T, n, 10), in SI units.

    momentum: p. torque: G (tau - offset) + friction compensation + dL/dq. friction: at the middle of the bounds of the
    friction state. uncertainty: half the difference of friction at both bounds. load_momentum: P. load_torque: N.
    jacobian: of a point of the last body, (T, 3, n), in root axes.
    """

    momentum: np.ndarray
    torque: np.ndarray
    friction: np.ndarray
    uncertainty: np.ndarray
    load_momentum: np.ndarray
    load_torque: np.ndarray
    jacobian: np.ndarray


@dataclass(frozen=True, eq=False)
class LoadAxes:
    """Joint axes as twists of the last body, in its frame: angular and linear parts, (T, bodies, 3).

    axes: twist of the last body per rate of each body's displacement. turning: its time derivative. twist: of the last
    body, (T, 1, 3). gravity: (T, 1, 3) [m/s^2]. rotation: to root axes, (T, 3, 3). ratios: displacements per joint
    position, zero for bodies that do not carry the last one, (bodies, n).
    """

    axes: tuple[Tensor, Tensor]
    turning: tuple[Tensor, Tensor]
    twist: tuple[Tensor, Tensor]
    gravity: Tensor
    rotation: Tensor
    ratios: Tensor

    def jacobian(self, point: Tensor) -> Tensor:
        """Return the Jacobian of a point (3,) of the last body [m], (T, 3, n), in root axes."""
        angular, linear = self.axes
        columns = (linear + _cross(angular, point.expand_as(angular))).mT @ self.ratios
        jacobian: Tensor = self.rotation @ columns
        return jacobian


def _cross(a: Tensor, b: Tensor) -> Tensor:
    product: Tensor = torch.linalg.cross(a, b, dim=-1)
    return product


def load_axes(model: RigidBodyDynamics, q: Tensor, qd: Tensor) -> LoadAxes:
    """Return the joint axes as twists of the last body of a model, at q and qd, (T, n)."""
    chain = model.chain
    count = len(chain.parents)
    # with the columns of the frames in place of points
    at = chain.forward(q, torch.eye(4 * count).to(q))
    _, twists, turning = chain.motion(at, qd)
    frame = at.place[..., -1, :]  # (T, 3, 4)
    rotation, origin = frame[..., :3], frame[..., 3].unsqueeze(-2)

    def at_body(twist: Tensor) -> tuple[Tensor, Tensor]:
        """Return twists (T, 6, bodies) at the origin of the last body, in its axes."""
        angular, linear = twist.mT.chunk(2, dim=-1)
        return angular @ rotation, (linear + _cross(angular, origin.expand_as(angular))) @ rotation

    ratios = chain.carriers[:, -1:] * chain.ratios
    gravity = -chain.base.reshape(1, 3) @ rotation
    return LoadAxes(at_body(at.axes), at_body(turning), at_body(twists[..., -1:]), gravity, rotation, ratios)


def _projected(axes: tuple[Tensor, Tensor], twist: tuple[Tensor, Tensor]) -> Tensor:
    """Return a . angular momentum + l . linear momentum per inertial parameter of a body with this twist, (T, bodies,
    10).

    Linear momentum is m v + w x mc, angular momentum I w + mc x v. axes: (a, l), (T, bodies, 3).
    """
    (a, l), (w, v) = axes, (x.expand_as(axes[0]) for x in twist)  # noqa: E741
    first = _cross(l, w) + _cross(v, a)
    products = a.unsqueeze(-1) * w.unsqueeze(-2)
    inertia = products + products.mT
    diagonal = (a * w).unbind(-1)
    (xx, yy, zz), (xy, xz, yz) = diagonal, (inertia[..., 0, 1], inertia[..., 0, 2], inertia[..., 1, 2])
    return torch.cat([(l * v).sum(-1, True), first, torch.stack([xx, xy, xz, yy, yz, zz], -1)], dim=-1)


def _weight(at: LoadAxes) -> Tensor:
    """Return the projection of the weight of a payload onto the axes, per parameter, (T, bodies, 10)."""
    a, l = at.axes  # noqa: E741
    gravity = at.gravity.expand_as(a)
    return torch.cat(
        [(l * gravity).sum(-1, True), _cross(gravity, a), torch.zeros_like(a).repeat(1, 1, 2)], -1
    )


def load_terms(at: LoadAxes) -> tuple[Tensor, Tensor]:
    """Return P and N of the momentum balance of a payload (see the module), (T, n, 10)."""
    momentum = at.ratios.mT @ _projected(at.axes, at.twist)
    return momentum, at.ratios.mT @ (_projected(at.turning, at.twist) + _weight(at))


def load_torque(model: RigidBodyDynamics, q: Tensor, qd: Tensor, qdd: Tensor, theta: Tensor) -> Tensor:
    """Return the joint torques for a payload theta (10,) at the last body, at accelerations qdd, (T, n) [Nm, N]."""
    at = load_axes(model, q, qd)
    # d/dt (P theta) = P(qdd) theta + the change of axes and of the body's frame: the wrench is
    # I A + V x* I V, with the acceleration A = sum axes qdd + turning qd
    rates, changes = (x @ at.ratios.mT for x in (qd, qdd))
    acceleration = []
    for axis, turning in zip(at.axes, at.turning, strict=True):
        acceleration.append((axis * changes.unsqueeze(-1) + turning * rates.unsqueeze(-1)).sum(-2, True))
    (a, l), (w, v) = at.axes, at.twist  # noqa: E741
    # a . (w x h + v x p) + l . (w x p) is the projection of I V onto the axes (a x w, l x w + a x v)
    turned = _cross(a, w.expand_as(a)), _cross(l, w.expand_as(l)) + _cross(a, v.expand_as(a))
    regressor = _projected(at.axes, (acceleration[0], acceleration[1])) + _projected(turned, at.twist)
    torque: Tensor = at.ratios.mT @ ((regressor - _weight(at)) @ theta.unsqueeze(-1))
    return torque.squeeze(-1)


def balance(
    model: RigidBodyDynamics, point: np.ndarray, samples: Sequence[np.ndarray], bounds: Sequence[np.ndarray]
) -> Balance:
    """Return the terms of the momentum balance at samples.

    Args:
        model: in double precision.
        point: of the last body, in its frame, whose Jacobian is returned, (3,) [m].
        samples: q, qd and tau, (T, n).
        bounds: lower and upper bound of the friction state, (T, n, K) [rad, m].
    """
    blocks: list[list[np.ndarray]] = []
    with torch.no_grad():
        for start in range(0, len(samples[0]), _BLOCK):
            tensors = [torch.from_numpy(x[start : start + _BLOCK]) for x in (*samples, *bounds)]
            blocks.append([x.numpy() for x in _terms(model, torch.from_numpy(point), *tensors)])
    return Balance(*map(np.concatenate, zip(*blocks, strict=True)))


def _terms(
    model: RigidBodyDynamics, point: Tensor, q: Tensor, qd: Tensor, tau: Tensor, *bounds: Tensor
) -> list[Tensor]:
    at = model.at(q, qd)
    torque = model.input_force(at, qd, tau) + model.lagrangian_gradient(at, qd)
    if is_stateful(model):
        low, high = (model.friction_torque(at, qd, z) for z in bounds)
    else:
        low = high = model.friction_torque(at, qd)
    axes = load_axes(model, q, qd)
    terms = model.momentum(at, qd), torque, (high + low) / 2, (high - low).abs() / 2
    return [*terms, *load_terms(axes), axes.jacobian(point)]
