"""Derive what logs of commanded positions can determine of an arm at all, from the rank of its equations.

Of each joint kp (u - q) = kd qd + armature qdd + dry sgn(qd) + Y(q, qd, qdd) pi, with q and u known: linear and
homogeneous in all that is not, so that logs determine kp, kd, armature, dry and pi up to the null space of these
columns. What changes there by the same factor as kp is known in ratio to it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spelgen.arm.arm import Arm
from spelgen.structure.recursion import triangle
from spelgen.structure.sampling import float_energies

PARAMETERS = ("kp", "kd", "armature", "dry")
ROUNDING = 1e-9  # of the largest singular value
EQUAL = 1e-6  # rounding of null vectors is a thousand times that of the columns


@dataclass(frozen=True)
class ServoRank:
    """Say what is known in ratio to what.

    groups: joints whose kp are known in ratio to one another, so that one kp, mass or load determines all of them.
    open: what of which joint is not even known in ratio to its kp: only together with what the bodies are.
    """

    groups: tuple[tuple[int, ...], ...]
    open: tuple[tuple[str, int], ...]


def servo_rank(arm: Arm) -> ServoRank:
    """Return it by random states, parameters and drives: the rank is that of almost all, whatever the arm weighs."""
    random, n = np.random.default_rng(0), len(arm.coordinates)
    samples = 2 * (10 * len(arm.bodies) // n + len(PARAMETERS)) + 20
    q, qd, qdd = random.normal(size=(3, samples, n))
    columns = torque_rows(arm, q, qd, qdd).reshape(samples * n, -1)
    identifiable, _ = _row_and_null_space(columns)
    bodies = columns @ (
        identifiable * random.uniform(0.5, 2.0, identifiable.shape[1])
    )  # of unknowns that are 1
    drives = np.stack([qd, qdd, np.sign(qd)], axis=-1) * random.uniform(0.5, 2.0, (n, 3))
    torque = drives.sum(axis=-1) + bodies.sum(axis=-1).reshape(samples, n)
    rows = np.zeros((samples, n, n, len(PARAMETERS)))
    for joint in range(n):
        rows[:, joint, joint, 0] = -torque[:, joint]
        rows[:, joint, joint, 1:] = drives[:, joint]
    system = np.concatenate([rows.reshape(samples * n, -1), bodies], axis=1)
    size = np.linalg.norm(system, axis=0)
    _, null = _row_and_null_space(system / size)
    changes = (null / size[:, None])[: n * len(PARAMETERS)].reshape(n, len(PARAMETERS), -1)
    changes = changes / np.abs(changes).max()
    groups: list[list[int]] = []
    in_no_ratio = []
    for joint in range(n):
        for group in groups:
            if np.abs(changes[group[0], 0] - changes[joint, 0]).max() < EQUAL:
                group.append(joint)
                break
        else:
            groups.append([joint])
        apart = np.abs(changes[joint] - changes[joint, 0]).max(axis=-1) > EQUAL
        in_no_ratio += [(PARAMETERS[k], joint) for k in np.flatnonzero(apart)]
    in_no_ratio.sort(key=lambda entry: PARAMETERS.index(entry[0]))
    return ServoRank(tuple(map(tuple, groups)), tuple(in_no_ratio))


def torque_rows(arm: Arm, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
    """Return by which (S, n, 10 B) the bodies' inertial parameters make torques, by Lagrange's equations.

    Derivatives by complex steps (Squire and Trapp, SIAM Review 40:110, 1998), which lose no digit. It is `regressor`
    without torch, which a derivation does not load.
    """
    samples, n = q.shape
    step = 1e-30
    # along each coordinate alone, and along the motion
    ways = np.concatenate([np.tile(np.eye(n), (samples, 1, 1)), qd[:, None]], axis=1)  # (S, n + 1, n)
    inertias = np.split(np.eye(10 * len(arm.bodies)), len(arm.bodies))
    moved = q[:, None, None] + 1j * step * ways[:, :, None]
    triangles, potential = float_energies(arm, moved, [list(ten) for ten in inertias])
    mass = np.zeros((*potential.shape, n, n), dtype=complex)  # (S, n + 1, 10 B, n, n)
    for entry, (row, column) in enumerate(triangle(n)):
        mass[..., row, column] = mass[..., column, row] = triangles[..., entry]
    momentum = np.einsum("spij,sj->sip", mass[:, n], qd + 1j * step * qdd)
    kinetic = np.einsum("skpij,si,sj->skp", mass[:, :n], qd, qd) / 2
    torque: np.ndarray = (momentum - kinetic + potential[:, :n]).imag / step
    return torque


def _row_and_null_space(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return orthonormal bases of both (columns, dimension), of a matrix of more rows than columns."""
    _, sizes, directions = np.linalg.svd(matrix, full_matrices=False)
    rank = int((sizes > ROUNDING * sizes[0]).sum())
    return directions[:rank].T, directions[rank:].T
