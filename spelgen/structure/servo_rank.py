"""Identifiability of servo and inertial parameters from logs of commanded positions, by a numerical rank.

For each joint with a position servo, kp (u - q) = kd qd + armature qdd + dry sgn(qd) + Y(q, qd, qdd) pi, with logged
position q and command u, dry friction torque `dry`, torque regressor Y and inertial parameters pi. The equations are
linear and homogeneous in kp, kd, armature, dry and pi: logs determine these parameters up to an added vector of the
null space of the equations. The ratio of a parameter to kp is identifiable if adding any such vector multiplies the
parameter and kp by the same factor.
"""

from typing import NamedTuple

import numpy as np

from spelgen.arm.arm import Chain
from spelgen.structure.recursion import triangle
from spelgen.structure.sampling import float_energies

PARAMETERS = ("kp", "kd", "armature", "dry")


class ServoRank(NamedTuple):
    """Identifiable ratios between the parameters of position servos, from logs of commanded positions.

    The parameters of a joint are kp, kd, armature and dry friction.

    Attributes:
        groups: sets of joints (0-based). Within a set, all ratios of two kp are identifiable, so that one known kp,
            mass or load determines all parameters of the set.
        open: pairs (parameter, joint) whose ratio to the kp of the joint is not identifiable; such a parameter can be
            identified only together with the inertial parameters of the bodies.
    """

    groups: tuple[tuple[int, ...], ...]
    open: tuple[tuple[str, int], ...]


def servo_rank(arm: Chain) -> ServoRank:
    """Return the identifiable ratios between servo parameters, for an arm whose joints all have position servos.

    The ratios, such as kd / kp of a joint or kp of one joint / kp of another, are computed from the null space of the
    equations of motion under servo torques (see the module), at random states and for random true parameters.
    """
    random, n = np.random.default_rng(0), len(arm.coordinates)
    # There are about twice as many equations as unknowns, so that the number of samples does not limit the rank.
    samples = 2 * (10 * len(arm.bodies) // n + len(PARAMETERS)) + 20
    q, qd, qdd = random.normal(size=(3, samples, n))
    columns = torque_rows(arm, q, qd, qdd).reshape(samples * n, -1)
    identifiable, _ = _row_and_null_space(columns)
    # The true parameters are random. Each column of the equations is multiplied by the true value of its parameter: the
    # solution of the scaled equations is then 1 for all parameters.
    bodies = columns @ (identifiable * random.uniform(0.5, 2.0, identifiable.shape[1]))
    drives = np.stack([qd, qdd, np.sign(qd)], axis=-1) * random.uniform(0.5, 2.0, (n, 3))
    torque = drives.sum(axis=-1) + bodies.sum(axis=-1).reshape(samples, n)
    rows = np.zeros((samples, n, n, len(PARAMETERS)))
    for joint in range(n):
        # The coefficient of kp in kp (u - q) = torque is the command error u - q, which equals the torque for kp = 1.
        rows[:, joint, joint, 0] = -torque[:, joint]
        rows[:, joint, joint, 1:] = drives[:, joint]
    system = np.concatenate([rows.reshape(samples * n, -1), bodies], axis=1)
    # The columns of the system are scaled to unit length, so that the threshold of singular values has no unit.
    norms = np.linalg.norm(system, axis=0)
    _, null = _row_and_null_space(system / norms)
    changes = (null / norms[:, None])[: n * len(PARAMETERS)].reshape(n, len(PARAMETERS), -1)
    changes = changes / np.abs(changes).max()
    # [1] Two relative changes of parameters count as equal if they differ by less than `equal`. `changes`, (n,
    # parameters, null vectors): relative changes of the servo parameters along each null vector, scaled to a largest
    # magnitude of 1. Rounding errors are far smaller: about 1e-16 in the system matrix, and 1e-13 in its null vectors.
    equal, kp = 1e-6, changes[:, :1]
    # `same`, (n, n): True for two joints whose kp have equal relative changes along each null vector.
    same = np.abs(kp - changes[None, :, 0]).max(axis=-1) < equal
    groups = dict.fromkeys(tuple(np.flatnonzero(row).tolist()) for row in same)
    # `differs`, (n, parameters of a joint): False for a parameter whose relative change equals the relative change of
    # the kp of its joint along each null vector.
    differs = np.abs(changes - kp).max(axis=-1) > equal
    undetermined = [(PARAMETERS[k], joint) for k, joint in np.argwhere(differs.T).tolist()]
    return ServoRank(tuple(groups), tuple(undetermined))


def torque_rows(arm: Chain, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
    """Return the torque regressor Y, (S, n, 10 B), of B bodies at S states, from Lagrange's equations.

    Args:
        arm: the arm.
        q: positions (S, n) [rad, m].
        qd: velocities (S, n) [rad/s, m/s].
        qdd: accelerations (S, n) [rad/s^2, m/s^2].

    Derivatives are complex-step derivatives (Squire and Trapp, SIAM Review 40:110, 1998), which have no cancellation.
    `dynamics.body_regressor` is not used, because it imports torch, and the derivation of the structure does not.
    """
    samples, n = q.shape
    step = 1e-30
    # q is shifted by an imaginary step in n + 1 `directions`, (S, n + 1, n), for derivatives: the n coordinate axes,
    # for d/dq, and last qd, for d/dt.
    directions = np.concatenate([np.tile(np.eye(n), (samples, 1, 1)), qd[:, None]], axis=1)
    inertias = np.split(np.eye(10 * len(arm.bodies)), len(arm.bodies))
    shifted = q[:, None, None] + 1j * step * directions[:, :, None]
    triangles, potential = float_energies(arm, shifted, [list(ten) for ten in inertias])
    # `mass`, (S, n + 1, 10 B, n, n): M per unit of each of the 10 B inertial parameters of the B bodies, for S samples,
    # at the complex positions q + i step d for each of the n + 1 `directions` d. Its imaginary part divided by `step`
    # is the derivative of M in the direction d.
    mass = np.zeros((*potential.shape, n, n), dtype=complex)
    for entry, (row, column) in enumerate(triangle(n)):
        mass[..., row, column] = mass[..., column, row] = triangles[..., entry]
    # tau = d/dt (M qd) - d/dq (qd^T M qd / 2) + dV/dq, with complex-step derivatives. For d/dt, `momentum` is the
    # product of M at q + i step qd (the last of `directions`) and qd + i step qdd: its imaginary part is
    # step d/dt (M qd). For d/dq, M and V are evaluated at q + i step e_k, with the unit vectors e_k.
    momentum = np.einsum("spij,sj->sip", mass[:, n], qd + 1j * step * qdd)
    kinetic = np.einsum("skpij,si,sj->skp", mass[:, :n], qd, qd) / 2
    return np.asarray((momentum - kinetic + potential[:, :n]).imag / step)


def _row_and_null_space(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return orthonormal bases of the row space, (k, rank), and the null space, (k, k - rank), of a matrix.

    matrix: (m, k) with m >= k.
    """
    _, singular_values, directions = np.linalg.svd(matrix, full_matrices=False)
    # Singular values below 1e-9 times the largest singular value are rounding errors.
    rank = int((singular_values > 1e-9 * singular_values[0]).sum())
    return directions[:rank].T, directions[rank:].T
