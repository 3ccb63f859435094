"""Physically consistent inertial parameters: the 4 x 4 pseudo-inertia of a body and its log-Cholesky coordinates.

A body's ten parameters are those of some distribution of mass exactly where J = [[S, h], [h^T, m]] with
S = tr(I)/2 1 - I is positive definite (Wensing, Kim and Slotine, IEEE RA-L 3:60, 2018). Here J = C T T^T C^T, with
C the Cholesky factor of a reference body and T lower triangular, its diagonal exponentials of coordinates: every
choice of ten numbers is a possible body (Rucker and Wensing, IEEE RA-L 7:4352, 2022), zero is the reference, and
to first order the distance from it is that of the affine-invariant metric, which knows no units and no frames.
"""

from __future__ import annotations

import numpy as np

LOWER = tuple((row, column) for row in range(4) for column in range(row + 1))
"""Where the ten coordinates stand in T."""

_LEAST_RELATIVE = 1e-4
"""Of the largest eigenvalue of J: what an impossible body's negative and zero ones are raised to."""


def pseudo_inertia(parameters: np.ndarray) -> np.ndarray:
    """J (..., 4, 4) of (m, h, I), (..., 10), in the order of ``Body.inertia``."""
    m, hx, hy, hz, xx, xy, xz, yy, yz, zz = np.moveaxis(np.asarray(parameters, dtype=float), -1, 0)
    half = (xx + yy + zz) / 2
    rows = ((half - xx, -xy, -xz, hx), (-xy, half - yy, -yz, hy), (-xz, -yz, half - zz, hz), (hx, hy, hz, m))
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def parameters_of(pseudo: np.ndarray) -> np.ndarray:
    """The inverse of ``pseudo_inertia``: (..., 4, 4) -> (..., 10)."""
    s, h, m = pseudo[..., :3, :3], pseudo[..., :3, 3], pseudo[..., 3, 3]
    trace = np.trace(s, axis1=-2, axis2=-1)
    inertia = trace[..., None, None] * np.eye(3) - s
    return np.concatenate([m[..., None], h, inertia[..., *np.triu_indices(3)]], axis=-1)


def reference_factor(parameters: np.ndarray) -> tuple[np.ndarray, bool]:
    """C (4, 4) with C C^T = J of a body, and whether the body is a possible one.

    For one that is not, J is the nearest that is, its least eigenvalues raised.
    """
    pseudo = pseudo_inertia(parameters)
    values, vectors = np.linalg.eigh(pseudo)
    least = _LEAST_RELATIVE * values[-1]
    possible = bool(values[0] > least * _LEAST_RELATIVE)
    if not possible:
        pseudo = (vectors * np.maximum(values, least)) @ vectors.T
    return np.linalg.cholesky(pseudo), possible


def sensitivity(factor: np.ndarray) -> np.ndarray:
    """d(m, h, I) / d(coordinates) at the reference body, (10, 10)."""
    columns = []
    for row, column in LOWER:
        change = np.zeros((4, 4))
        change[row, column] = 1.0
        columns.append(parameters_of(factor @ (change + change.T) @ factor.T))
    return np.stack(columns, axis=-1)
