"""Prior of inertial parameters at the URDF: independent errors of masses, centres of mass and tensors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spelgen.arm.arm import Chain
from spelgen.identification.tuning import GEOMETRY


@dataclass(frozen=True, eq=False)
class InertialPrior:
    """Student-t prior of the inertial parameters (10 B,) of B bodies.

    mean: (10 B,). precision: (10 B, 10 B), inverse of the scale matrix. freedom: half the
    sum of degrees of freedom and number of parameters, the factor of log(1 + distance^2 / freedom).
    """

    mean: np.ndarray
    precision: np.ndarray
    freedom: float


def inertial_prior(arm: Chain) -> InertialPrior:
    """Return the prior of an arm; a body without an inertial has a wide prior about 0."""
    masses = [float(body.inertia[0]) for body in arm.bodies if body.inertia and body.inertia[0] > 0]
    typical = float(np.median(masses)) if masses else 1.0
    size = 10 * len(arm.bodies)
    mean, precision = np.zeros(size), np.zeros((size, size))
    for k, body in enumerate(arm.bodies):
        lengths = [np.linalg.norm(np.array(x.translation, dtype=float)) for x in arm.bodies if x.parent == k]
        block = slice(10 * k, 10 * k + 10)
        mean[block] = np.array(body.inertia or (0.0,) * 10, dtype=float)
        root = _root(mean[block], float(max(lengths, default=0.0)), typical)
        precision[block, block] = np.linalg.inv(root @ root.T)
    return InertialPrior(mean, precision, 0.5 * size)


def _root(own: np.ndarray, length: float, typical: float) -> np.ndarray:
    """Return a root (10, 10) of the covariance of (m, m c, I) of a body.

    The columns are the derivatives with respect to the mass at a fixed shape, the centre of mass and the tensor about
    the centre, times their standard deviations. own: (10,). length: to the next joint [m]. typical: mass of a body
    without an inertial [kg].
    """
    if own[0] <= 0:
        extent = max(length, GEOMETRY.unknown_extent)
        lengths = np.repeat([1.0, extent, extent**2], (1, 3, 6))
        return GEOMETRY.unknown_mass * typical * np.diag(lengths)
    mass = own[0]
    center, moments = own[1:4] / mass, own[[4, 7, 9]]
    gyration = np.sqrt(max(float(moments.sum() / 2 / mass - center @ center), 0.0))
    extent = max(float(np.linalg.norm(center)), gyration, length / 2, GEOMETRY.min_extent)
    radius = max(gyration, GEOMETRY.min_gyration * extent)
    root = np.zeros((10, 10))
    root[:, 0] = own
    for axis, unit in enumerate(np.eye(3)):
        product = np.outer(center, unit) + np.outer(unit, center)
        tensor = np.trace(product) * np.eye(3) - product
        root[1:4, 1 + axis] = mass * extent * unit
        root[4:, 1 + axis] = mass * extent * tensor[np.triu_indices(3)]
    root[4:, 4:] = mass * radius**2 * np.eye(6)
    return GEOMETRY.relative_error * root
