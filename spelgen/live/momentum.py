"""Terms of the momentum balance of an arm and of a payload at its last body, at measured states.

The generalised momentum p = M qd of the arm, and P theta of a payload with the ten inertial parameters theta, obey

    d/dt (p + P theta) = G (tau - offset) + dL/dq - friction + N theta + external torque,

with L the Lagrangian (De Luca and Mattone, ICRA 2005): no acceleration is needed.
"""

from __future__ import annotations

from collections.abc import Sequence
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


def _cross(a: Tensor, b: Tensor) -> Tensor:
    product: Tensor = torch.linalg.cross(a, b.expand_as(a), dim=-1)
    return product


def load_terms(model: RigidBodyDynamics, q: Tensor, qd: Tensor, point: Tensor) -> tuple[Tensor, ...]:
    """Return P and N, (T, n, 10), and the Jacobian of a point of the last body, (T, 3, n), in root axes.

    Args:
        model: in double precision.
        q, qd: (T, n).
        point: in the frame of the last body, (3,) [m].
    """
    chain = model.chain
    # with the columns of the frames in place of points
    at = chain.forward(q, torch.eye(4 * len(chain.parents)).to(q))
    _, twists, turning = chain.motion(at, qd)
    frame = at.place[..., -1, :]  # (T, 3, 4)
    rotation, origin = frame[..., :3], frame[..., 3].unsqueeze(-2)

    def at_body(twist: Tensor) -> tuple[Tensor, Tensor]:
        """Return twists (T, 6, bodies), angular and linear, at the origin of the last body and in its axes."""
        angular, linear = twist.mT.chunk(2, dim=-1)
        return angular @ rotation, (linear + _cross(angular, origin)) @ rotation

    # twists of the last body per rate of each body's displacement, and their time derivatives
    axes, turned, twist = at_body(at.axes), at_body(turning), at_body(twists[..., -1:])
    angular, linear = axes
    gravity = (-chain.base.reshape(1, 3) @ rotation).expand_as(angular)
    weight = [
        (linear * gravity).sum(-1, True),
        _cross(gravity, angular),
        torch.zeros_like(angular).repeat(1, 1, 2),
    ]
    # displacements per joint position, zero for bodies that do not carry the last one, (bodies, n)
    ratios = chain.carriers[:, -1:] * chain.ratios
    momentum = ratios.mT @ _projected(axes, twist)
    force = ratios.mT @ (_projected(turned, twist) + torch.cat(weight, -1))
    jacobian: Tensor = rotation @ ((linear + _cross(angular, point)).mT @ ratios)
    return momentum, force, jacobian


def _projected(axes: tuple[Tensor, Tensor], twist: tuple[Tensor, Tensor]) -> Tensor:
    """Return a . angular momentum + l . linear momentum per inertial parameter of a body with this twist, (T, bodies,
    10).

    Linear momentum is m v + w x mc, angular momentum I w + mc x v. axes: (a, l), (T, bodies, 3).
    """
    (a, l), (w, v) = axes, (x.expand_as(axes[0]) for x in twist)  # noqa: E741
    products = a.unsqueeze(-1) * w.unsqueeze(-2)
    rows, columns = torch.triu_indices(3, 3)
    # an entry off the diagonal occurs twice in I
    inertia = (products + products.mT)[..., rows, columns] * torch.where(rows == columns, 0.5, 1.0)
    return torch.cat([(l * v).sum(-1, True), _cross(l, w) + _cross(v, a), inertia], dim=-1)


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
    terms = model.momentum(at, qd), torque, (high + low) / 2, (high - low).abs() / 2
    return [*terms, *load_terms(model, q, qd, point)]
