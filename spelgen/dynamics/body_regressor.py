"""Inertial parameters of bodies: in the form that simulators take, as pseudo-inertias, and their regressor."""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from spelgen.runtime.body_chain import BodyChain
from spelgen.runtime.port_hamiltonian import applied


def about_center(inertia: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Return mass, centre of mass and inertia about it, (3, 3), from the ten parameters in the joint's frame."""
    mass = inertia[0]
    center = inertia[1:4] / mass
    xx, xy, xz, yy, yz, zz = inertia[4:]
    about_joint = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    # the parallel axis theorem
    shift = center @ center * np.eye(3) - np.outer(center, center)
    return mass, center, about_joint - mass * shift


def quaternion(rotation: object) -> np.ndarray:
    """Return (w, x, y, z) of a rotation, (3, 3), w not negative."""
    matrix = np.array(rotation, dtype=float)
    result: np.ndarray = np.roll(Rotation.from_matrix(matrix).as_quat(canonical=True), 1)
    result[np.abs(result) < 1e-16] = 0.0  # rounding
    return result


def pseudo_inertia(ten: Tensor) -> Tensor:
    """Return [[tr(I)/2 - I, m c], [(m c)^T, m]], (..., 4, 4), of inertial parameters (m, m c, I), (..., 10).

    It is positive definite if and only if the parameters are physically consistent (Wensing, Kim and Slotine,
    IEEE RA-L 3:60, 2018).
    """
    m, x, y, z, xx, xy, xz, yy, yz, zz = ten.unbind(dim=-1)
    half = (xx + yy + zz) / 2
    rows = [half - xx, -xy, -xz, x, -xy, half - yy, -yz, y, -xz, -yz, half - zz, z, x, y, z, m]
    return torch.unflatten(torch.stack(rows, dim=-1), -1, (4, 4))


def regressor_of(chain: BodyChain, q: Tensor, qd: Tensor, qdd: Tensor) -> Tensor:
    """Return Y, (..., n, 10 bodies): joint torques [Nm, N] are Y @ inertial parameters.

    Args:
        chain: kinematics of the bodies.
        q, qd, qdd: motion of the joints, (..., n) [rad, m], per s, per s^2.
    """
    count = len(chain.parents)
    # with the columns of the frames in place of points, kinetic energy is linear in the pseudo-inertias
    pose = chain.forward(q, torch.eye(4 * count).to(q))
    rises = chain.accelerations(pose, qd) + applied(pose.jacobian.mT, qdd @ chain.ratios.mT)
    rises = torch.unflatten(rises, -1, (3, count, 4))
    jacobian = torch.unflatten(chain.ratios.mT @ pose.jacobian, -1, (3, count, 4))
    products = torch.einsum("...nxba,...xbc->...nbac", jacobian, rises)
    rows: Tensor = torch.tensordot(products, pseudo_inertia(torch.eye(10).to(q)), dims=([-2, -1], [1, 2]))
    return rows.flatten(-2)


def chain_regressor(chain: BodyChain, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
    """Return Y, (T, n, 10 bodies), for arrays q, qd, qdd (T, n); see ``regressor_of``."""
    # copies: torch does not accept arrays with negative strides, which filters return
    states = [torch.from_numpy(np.array(x, dtype=float)) for x in (q, qd, qdd)]
    with torch.no_grad():
        return np.asarray(regressor_of(chain, *states))
