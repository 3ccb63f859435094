"""Inertial parameters of bodies: in the form that simulators take, as pseudo-inertias, their regressor and its base.

Base parameters are equal to `identification.base_parameters`, but from the kinematics only, without exact arithmetic.
"""

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from spelgen.labels import BASE_ORDER, INERTIAL_PARAMETERS, parameter_name
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
    # scipy has (x, y, z, w)
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


def constants_regressor(chain: BodyChain, motors: Tensor, q: Tensor, qd: Tensor, qdd: Tensor) -> Tensor:
    """Return the derivative of joint torques with respect to the inertial parameters and armatures.

    Args:
        chain: kinematics of B bodies.
        motors: C, (n, n), the drives rotate at C qd.
        q, qd, qdd: motion of the joints, (T, n) [rad, m], per s, per s^2.

    Returns:
        (T, n, 10 B + n).
    """
    rotors = (qdd @ motors.mT).unsqueeze(-2) * motors.mT
    return torch.cat([regressor_of(chain, q, qd, qdd), rotors], dim=-1)


def base_combinations(chain: BodyChain, motors: Tensor) -> tuple[tuple[str, ...], Tensor]:
    """Return names and coefficients (r, 10 B + n) of the base parameters; see `constants_regressor`.

    A column of the regressor at random states in the span of the columns before it is regrouped into these (Gautier and
    Khalil, IEEE T-RA 6:368, 1990).
    """
    n, inertial = len(motors), 10 * len(chain.parents)
    # parameters that can always be regrouped come last, so that the conventional ones are kept
    order = [
        10 * body + INERTIAL_PARAMETERS.index(name) for body in range(inertial // 10) for name in BASE_ORDER
    ]
    order += range(inertial, inertial + n)
    shape = (3, 2 * len(order) // n + 1, n)  # twice as many equations as parameters
    motion = torch.from_numpy(np.random.default_rng(0).uniform(-3.0, 3.0, shape))
    columns = constants_regressor(chain, motors, *motion).flatten(0, 1)
    # norm of each column after projection onto the complement of all columns before it
    remainder = torch.linalg.qr(columns[:, order]).R.diagonal().abs()
    # linearly dependent if the part orthogonal to all columns before it is shorter than 1e-8 of the column: above
    # rounding errors
    is_base = remainder > 1e-8 * columns[:, order].norm(dim=0).clamp(min=1.0)
    base = torch.tensor(order)[is_base]
    combination = torch.linalg.lstsq(columns[:, base], columns).solution
    # smaller coefficients are rounding errors
    combination[combination.abs() < 1e-9] = 0.0
    names = []
    for index, row in zip(base.tolist(), combination, strict=True):
        if index < inertial:
            regrouped = int(row[:inertial].count_nonzero()) > 1
            names.append(parameter_name(index) + "R" * regrouped)
        else:
            names.append(f"armature{index - inertial + 1}")
    return tuple(names), combination
