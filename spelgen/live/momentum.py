"""Terms of the momentum balance, at measured states, of an arm with a payload that is fixed to the last body.

The generalised momentum p = M qd of the arm, and P theta of a payload with the ten inertial parameters theta, obey

    d/dt (p + P theta) = G (tau - offset) + dL/dq - friction + N theta + external torque,

with the input matrix G, the Lagrangian L of the arm, and regressors P and N of the payload's momentum and torque (De
Luca and Mattone, ICRA 2005). The balance contains no accelerations.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from spelgen.dynamics.body_regressor import load_body, pseudo_inertia
from spelgen.dynamics.protocol import is_stateful
from spelgen.runtime.body_chain import BodyChain
from spelgen.runtime.rigid_body_dynamics import RigidBodyDynamics, RigidParameters

_BLOCK = 2048  # [samples] The terms of the balance are computed in blocks of this length, to save memory.


class Balance(NamedTuple):
    """Terms of the momentum balance at T samples, in SI units.

    Attributes:
        momentum: Momentum p of the arm, (T, n).
        torque: G (tau - offset) + dL/dq, with the symbols of the module, plus the friction compensation of the drives,
            (T, n).
        friction: Mean of the friction torques at the two bounds of the friction state, (T, n).
        uncertainty: Half the difference of the friction torques at the two bounds, (T, n).
        load_momentum: P, momentum per inertial parameter of the payload, (T, n, 10).
        load_torque: N, torque per inertial parameter of the payload, (T, n, 10).
        jacobian: Jacobian of a point of the last body, such as the tip, in root axes, (T, 3, n).
        velocity: Velocities qd, (T, n).
    """

    momentum: np.ndarray
    torque: np.ndarray
    friction: np.ndarray
    uncertainty: np.ndarray
    load_momentum: np.ndarray
    load_torque: np.ndarray
    jacobian: np.ndarray
    velocity: np.ndarray


def load_terms(chain: BodyChain, q: Tensor, qd: Tensor, point: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the terms of a payload in the momentum balance, and the Jacobian of a point of the last body.

    Args:
        chain: kinematics of the bodies.
        q, qd: positions [rad, m] and velocities [rad/s, m/s], (T, n).
        point: position of the point in the frame of the last body, (3,) [m].

    Returns:
        P and N of the module's equation: generalised momentum, and centrifugal and gravity torque, per inertial
        parameter of the payload, (T, n, 10) each; Jacobian of the point in root axes, (T, 3, n).
    """
    # `chain.forward` transforms points of the bodies. The columns of the identity are passed as points, so that the
    # result contains the whole homogeneous transform of each body.
    pose = chain.forward(q, torch.eye(4 * len(chain.parents)).to(q))
    velocities, _, turning = chain.motion(pose, qd)
    last = load_body(chain)
    # `frame` is the homogeneous transform of the last body, (T, 1, 4, 4).
    frame = torch.cat([pose.place, pose.mass], dim=-3)[..., [last], :].movedim(-2, -3)
    velocity = velocities[..., last, :]  # Time derivative of the frame of the last body, (T, 3, 4).
    axes, turned = (torch.unflatten(x.mT @ chain.motions, -1, (3, 4)) for x in (pose.axes, turning))
    # `jacobian` is the derivative of the frame of the last body with respect to q, and `rate` its time derivative,
    # (T, n, 3, 4) each. Only joints between the root and the last body contribute.
    ratios = chain.carriers[:, [last]] * chain.ratios
    changes = axes @ frame, turned @ frame + axes[..., :3] @ velocity.unsqueeze(-3)
    jacobian, rate = (torch.einsum("bn,tbxa->tnxa", ratios, change) for change in changes)
    weight = torch.zeros_like(velocity)
    weight[..., 3] = -chain.base.flatten()
    directions, vectors = torch.stack([jacobian, rate, jacobian]), torch.stack([velocity, velocity, weight])
    # Momentum, centrifugal torque and gravity torque of the payload have the form tr(A J B^T), with the payload's
    # pseudo-inertia J (4, 4), A from `directions` and B from `vectors`, (3, 4) each. The three quantities are linear in
    # J, with the coefficients A^T B (4, 4) in `products`. `units` is the derivative of J with respect to the ten
    # inertial parameters.
    products = torch.einsum("ktnxa,ktxb->ktnab", directions, vectors)
    units = pseudo_inertia(torch.eye(10).to(q))
    momentum, centrifugal, weighed = torch.tensordot(products, units, dims=([-2, -1], [1, 2]))
    return momentum, centrifugal + weighed, (jacobian @ torch.cat([point, point.new_ones(1)])).mT


def balance(
    model: RigidBodyDynamics,
    point: np.ndarray,
    samples: Sequence[np.ndarray],
    bounds: Sequence[np.ndarray],
    prepared: RigidParameters | None = None,
) -> Balance:
    """Return the terms of the momentum balance of an arm at T measured samples.

    Args:
        model: model in double precision.
        point: point of the last body, in the frame of this body, whose Jacobian is returned, (3,) [m].
        samples: q [rad, m], qd [rad/s, m/s] and tau [Nm, N], (T, n) each.
        bounds: lower and upper bound of the friction state of K bristles per drive, (T, n, K) [rad, m].
        prepared: parameter cache of the model; None: the function computes it.
    """
    with torch.no_grad():
        prepared = prepared or model.prepare()
        columns = [torch.from_numpy(x).split(_BLOCK) for x in (*samples, *bounds)]
        blocks = []
        for q, qd, tau, *limits in zip(*columns, strict=True):
            at = model.at(q, qd, prepared=prepared)
            torque = model.input_force(at, qd, tau) + model.lagrangian_gradient(at, qd)
            states = (torch.stack(limits),) if is_stateful(model) else ()
            low, high = model.friction_torque(at, qd, *states).expand(2, *qd.shape)
            terms = model.momentum(at, qd), torque, (high + low) / 2, (high - low).abs() / 2
            blocks.append([*terms, *load_terms(model.chain, q, qd, torch.from_numpy(point)), qd])
        return Balance(*(torch.cat(term).numpy() for term in zip(*blocks, strict=True)))
