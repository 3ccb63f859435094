"""Conversions of inertial parameters, the regressor of the joint torques, and numerical base parameters.

`base_combinations` computes base parameters of bodies and armatures numerically. Without armatures, the base parameters
are equal to the exact base parameters of `structure.base_parameters`.
"""

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from spelgen.labels import BASE_ORDER, INERTIAL_PARAMETERS, base_name, parameter_name
from spelgen.runtime.body_chain import BodyChain
from spelgen.runtime.parts import applied


def about_center(inertia: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Return mass [kg], centre of mass (3,) [m], and inertia (3, 3) [kg m^2] about the centre of mass, of a body.

    inertia: (m, m c, Ixx, Ixy, Ixz, Iyy, Iyz, Izz), (10,), about the origin of the joint frame. The results are in the
    joint frame, too.
    """
    mass = inertia[0]
    center = inertia[1:4] / mass
    xx, xy, xz, yy, yz, zz = inertia[4:]
    about_joint = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    # `mass * shift` is the inertia about the origin minus the inertia about the centre of mass (parallel-axis theorem).
    shift = center @ center * np.eye(3) - np.outer(center, center)
    return mass, center, about_joint - mass * shift


def quaternion(rotation: object) -> np.ndarray:
    """Return the unit quaternion (w, x, y, z), with w >= 0, of a rotation matrix, (3, 3)."""
    matrix = np.array(rotation, dtype=float)
    # SciPy returns quaternions in the order (x, y, z, w); `np.roll` moves w to the front.
    result: np.ndarray = np.roll(Rotation.from_matrix(matrix).as_quat(canonical=True), 1)
    result[np.abs(result) < 1e-16] = 0.0  # Elements of a quaternion below 1e-16 are rounding errors.
    return result


def pseudo_inertia(ten: Tensor) -> Tensor:
    """Return the pseudo-inertia [[tr(I)/2 E - I, m c], [(m c)^T, m]], (..., 4, 4), of inertial parameters (..., 10).

    E is the identity matrix. The pseudo-inertia is positive definite if and only if the inertial parameters are
    physically consistent (Wensing, Kim and Slotine, IEEE RA-L 3:60, 2018).

    ten: mass m, first moment m c, and inertia I (xx, xy, xz, yy, yz, zz) about the origin [kg, kg m, kg m^2].
    """
    m, x, y, z, xx, xy, xz, yy, yz, zz = ten.unbind(dim=-1)
    half = (xx + yy + zz) / 2
    rows = [half - xx, -xy, -xz, x, -xy, half - yy, -yz, y, -xz, -yz, half - zz, z, x, y, z, m]
    return torch.unflatten(torch.stack(rows, dim=-1), -1, (4, 4))


_DERIVATIVES = pseudo_inertia(torch.eye(10).double()).permute(2, 1, 0).flatten(1)
"""Derivatives of entry (a, c) of `pseudo_inertia` with respect to parameter k, (4, 40): row c, column 10 a + k."""


def regressor_of(chain: BodyChain, q: Tensor, qd: Tensor, qdd: Tensor) -> Tensor:
    """Return the regressor Y of B bodies, (..., n, 10 B): the joint torques are Y @ inertial parameters [Nm, N].

    Column 10 b + i belongs to parameter i of body b: (m, m c, Ixx, Ixy, Ixz, Iyy, Iyz, Izz) about the joint frame's
    origin. Y has no columns for armature and friction.

    Args:
        chain: kinematics of the bodies, with gravity.
        q, qd, qdd: positions [rad, m], velocities [rad/s, m/s] and accelerations [rad/s^2, m/s^2], (..., n).
    """
    count = len(chain.parents)
    # The kinetic energy of a body is 1/2 tr(T' J T'^T): linear in its pseudo-inertia J (4 x 4). T is the homogeneous
    # transform of the body, T' its time derivative. `chain.forward` returns T times four given points: T itself if the
    # points are the columns of the identity. `rises` is T'' minus the acceleration of gravity.
    pose = chain.forward(q, torch.eye(4 * count).to(q))
    rises = chain.accelerations(pose, qd) + applied(pose.jacobian.mT, qdd @ chain.ratios.mT)
    rises = torch.unflatten(rises, -1, (3, count, 4))
    # Without mimic joints, `ratios` is the identity. The product with it would take a tenth of the time of this
    # function and is omitted.
    identical = torch.equal(chain.ratios, torch.eye(count).to(chain.ratios))
    jacobian = pose.jacobian if identical else chain.ratios.mT @ pose.jacobian
    jacobian = torch.unflatten(jacobian, -1, (3, count, 4))
    # `forces`, (..., B, 12, 10): the derivative of the inertial force T'' J of each body, (3, 4), with respect to its
    # ten inertial parameters; T'' is `rises`, (3, 4), J the pseudo-inertia, (4, 4). The product of `jacobian` and
    # `forces` takes half the time of the other order, in which `jacobian` is first multiplied by T'', (..., n, B, 4,
    # 4).
    forces = torch.unflatten(rises.transpose(-3, -2) @ _DERIVATIVES.to(q), -1, (4, 10)).flatten(-3, -2)
    rows: Tensor = jacobian.movedim(-2, -4).flatten(-2) @ forces
    return rows.transpose(-3, -2).flatten(-2)


def load_body(chain: BodyChain) -> int:
    """Return the index of the body of the last joint, which carries payloads, as `Chain.load_body` does."""
    return int(chain.ratios[:, -1].nonzero()[0])


def chain_regressor(chain: BodyChain, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
    """Return ``regressor_of`` for NumPy arrays q, qd, qdd (T, n): the regressor Y of B bodies, (T, n, 10 B)."""
    # The arrays are copied, since filters return arrays with negative strides, which torch does not accept.
    states = [torch.from_numpy(np.array(x, dtype=float)) for x in (q, qd, qdd)]
    with torch.no_grad():
        return np.asarray(regressor_of(chain, *states))


def constants_regressor(chain: BodyChain, motors: Tensor, q: Tensor, qd: Tensor, qdd: Tensor) -> Tensor:
    """Return the derivative of the joint torques with respect to inertial parameters and armatures (the regressor).

    Args:
        chain: kinematics of B bodies.
        motors: matrix C, (n, n): the velocities of the drives, whose rotors have the armatures, are C qd.
        q, qd, qdd: positions [rad, m], velocities [rad/s, m/s] and accelerations [rad/s^2, m/s^2], (T, n).

    Returns:
        (T, n, 10 B + n): columns of the inertial parameters, then of the armatures.
    """
    rotors = (qdd @ motors.mT).unsqueeze(-2) * motors.mT
    return torch.cat([regressor_of(chain, q, qd, qdd), rotors], dim=-1)


def base_combinations(chain: BodyChain, motors: Tensor) -> tuple[tuple[str, ...], Tensor]:
    """Return the r base parameters of an arm: their names, and their coefficients, (r, 10 B + n).

    A base parameter is a row of coefficients times the vector of all parameters: the inertial parameters of B bodies
    and the n armatures, in the order of the columns of `constants_regressor`. This regressor is evaluated at random
    states. If a column depends linearly on the preceding columns, its parameter is regrouped into the parameters of
    these columns (Gautier and Khalil, IEEE T-RA 6:368, 1990). The name of a base parameter with regrouped parameters
    ends with R.

    The parameters that are regrouped include torque offsets, since constant gravity along a prismatic joint cannot be
    distinguished from an offset. Rows and columns of the n offsets are omitted from the result.

    Args:
        chain: kinematics of B bodies.
        motors: matrix C, (n, n): the velocities of the drives are C qd.
    """
    n, inertial = len(motors), 10 * len(chain.parents)
    # A column can only be regrouped into preceding columns. By convention, Iyy, hz and m are regrouped: they are
    # therefore the last parameters in BASE_ORDER.
    order = [
        10 * body + INERTIAL_PARAMETERS.index(name) for body in range(inertial // 10) for name in BASE_ORDER
    ]
    order += range(inertial, inertial + 2 * n)
    # The random states give twice as many equations as parameters, so that they do not limit the rank.
    shape = (3, 2 * len(order) // n + 1, n)
    # In torch, the last digit of a result depends on the memory alignment of the arguments, which varies for NumPy
    # arrays. The random states are therefore copied to memory of torch.
    motion = torch.tensor(np.random.default_rng(0).uniform(-3.0, 3.0, shape))
    columns = constants_regressor(chain, motors, *motion)
    columns = torch.cat([columns, motors.mT.expand(len(columns), n, n)], dim=-1).flatten(0, 1)
    # Norm of each column after projection onto the orthogonal complement of all preceding columns.
    remainder = torch.linalg.qr(columns[:, order]).R.diagonal().abs()
    # A column is regarded as linearly dependent if its part orthogonal to all preceding columns is shorter than 1e-8
    # times the column, which exceeds rounding errors. For a column shorter than 1, the bound is 1e-8: a column that
    # contains only rounding errors is then regarded as dependent, too.
    is_base = remainder > 1e-8 * columns[:, order].norm(dim=0).clamp(min=1.0)
    base = torch.tensor(order)[is_base]
    # The results of lstsq's default driver, gelsy, differ in the last digit from call to call. The driver gels needs
    # columns of full rank, which base parameters have.
    combination = torch.linalg.lstsq(columns[:, base], columns, driver="gels").solution
    # Coefficients of base parameters below 1e-9 are rounding errors.
    combination[combination.abs() < 1e-9] = 0.0
    labels = [*map(parameter_name, range(inertial)), *(f"armature{joint + 1}" for joint in range(n))]
    names = []
    # The rows of torque offsets, which are the last rows, are omitted.
    for index, row in zip(base[base < len(labels)].tolist(), combination, strict=False):
        names.append(base_name(labels[index], int(row.count_nonzero())))
    return tuple(names), combination[: len(names), : len(labels)]
