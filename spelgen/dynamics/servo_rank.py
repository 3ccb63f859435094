"""What logs of commanded positions can tell of an arm at all: by the rank of its equations along a rich motion.

Of each joint kp (u - q) = kd qd + armature qdd + dry sgn(qd) + Y(q, qd, qdd) pi, with q and u known: linear and
homogeneous in all that is not, so that logs determine kp, kd, armature, dry and pi up to the null space of these
columns. What moves there by the same factor as kp is known in ratio to it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spelgen.arm.arm import Arm
from spelgen.dynamics.regressor import regressor

PARTS = ("kp", "kd", "armature", "dry")
NOTHING = 1e-9  # of the largest singular value
SAME = 1e-6
RANGE = 2.0  # rad, m to both sides of joints


@dataclass(frozen=True)
class ServoRank:
    """groups: joints whose kp are known in ratio to one another, so that one kp, mass or load tells all of them. open:
    what of which joint is not even known in ratio to its kp: only together with what the bodies are.
    """

    groups: tuple[tuple[int, ...], ...]
    open: tuple[tuple[str, int], ...]


def servo_rank(arm: Arm) -> ServoRank:
    """By random states, parameters and drives: the rank is that of almost all, whatever the arm weighs."""
    random, n = np.random.default_rng(0), len(arm.coordinates)
    samples = 2 * (10 * len(arm.bodies) // n + len(PARTS)) + 20
    q, (qd, qdd) = random.uniform(-RANGE, RANGE, (samples, n)), random.normal(size=(2, samples, n))
    columns = regressor(arm, q, qd, qdd)  # (T, n, 10 B)
    _, sizes, turned = np.linalg.svd(columns.reshape(samples * n, -1), full_matrices=False)
    felt = turned[sizes > NOTHING * sizes[0]].T
    bodies = columns @ (felt * random.uniform(0.5, 2.0, felt.shape[1]))  # (T, n, r), of unknowns that are 1
    drives = np.stack([qd, qdd, np.sign(qd)], axis=-1) * random.uniform(0.5, 2.0, (n, 3))
    torque = drives.sum(axis=-1) + bodies.sum(axis=-1)
    own = np.concatenate([-torque[..., None], drives], axis=-1)  # (T, n, 4)
    rows = np.zeros((samples, n, n, len(PARTS)))
    rows[:, range(n), range(n)] = own
    system = np.concatenate([rows.reshape(samples * n, -1), bodies.reshape(samples * n, -1)], axis=1)
    _, sizes, turned = np.linalg.svd(system / np.linalg.norm(system, axis=0))
    null = (turned[sizes < NOTHING * sizes[0]] / np.linalg.norm(system, axis=0)).T  # (unknowns, d)
    moved = null[: n * len(PARTS)].reshape(n, len(PARTS), -1)
    size = np.abs(moved).max()

    def alike(one: np.ndarray, other: np.ndarray) -> bool:
        return bool(np.abs(one - other).max() < SAME * size)

    groups: list[list[int]] = []
    for joint in range(n):
        known = next((group for group in groups if alike(moved[group[0], 0], moved[joint, 0])), None)
        if known is None:
            groups.append([joint])
        else:
            known.append(joint)
    left = [
        (name, joint)
        for k, name in enumerate(PARTS)
        for joint in range(n)
        if not alike(moved[joint, k], moved[joint, 0])
    ]
    return ServoRank(tuple(map(tuple, groups)), tuple(left))
