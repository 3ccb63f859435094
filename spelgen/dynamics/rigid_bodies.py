"""A rigid body and its placement in the numbers that simulators take: about its centre of mass, as a quaternion."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation


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
