"""The bodies of an arm as the runtime's own chain."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from spelgen.arm.arm import Arm
from spelgen.runtime.body_chain import BodyChain
from spelgen.runtime.parts import Row


def body_chain(arm: Arm) -> BodyChain:
    """Return how the arm's bodies may move, for q (..., n) [rad; m]."""
    rows: list[tuple[Any, ...]] = []
    for body in arm.bodies:
        geometry = tuple(map(_row, body.rotation)), _row(body.translation)
        is_revolute, ratio = body.kind == "revolute", float(body.multiplier)
        rows.append((body.parent, body.coordinate, is_revolute, ratio, body.offset, *geometry))
    return BodyChain(len(arm.coordinates), _row(arm.gravity), *zip(*rows, strict=True))


def about_center(inertia: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Return mass, centre of mass and the tensor about it, (3, 3), of ten parameters about the joint, in its frame."""
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


def _row(values: tuple[object, object, object]) -> Row:
    return tuple(map(float, values))  # type: ignore[arg-type]
