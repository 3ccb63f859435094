"""Keep inertial parameters physically consistent, by the 4 x 4 pseudo-inertia of a body.

A body's ten parameters are those of some distribution of mass exactly where J = [[S, h], [h^T, m]] with
S = tr(I)/2 1 - I is positive definite (Wensing, Kim and Slotine, IEEE RA-L 3:60, 2018).
"""

from __future__ import annotations

import numpy as np

from spelgen.structure.tuning import TUNING


def pseudo_inertia(parameters: np.ndarray) -> np.ndarray:
    """Return J (..., 4, 4) of (m, h, I), (..., 10), in the order of ``Body.inertia``."""
    values = np.asarray(parameters, dtype=float)
    tensor = np.zeros((*values.shape[:-1], 3, 3))
    rows, columns = np.triu_indices(3)
    tensor[..., rows, columns] = tensor[..., columns, rows] = values[..., 4:]
    pseudo = np.zeros((*values.shape[:-1], 4, 4))
    # second moments of mass from the tensor: I = tr(S) 1 - S
    pseudo[..., :3, :3] = _trace(tensor) / 2 * np.eye(3) - tensor
    pseudo[..., :3, 3] = pseudo[..., 3, :3] = values[..., 1:4]
    pseudo[..., 3, 3] = values[..., 0]
    return pseudo


def parameters_of(pseudo: np.ndarray) -> np.ndarray:
    """Return the inverse of ``pseudo_inertia``: (..., 4, 4) -> (..., 10)."""
    second_moment = pseudo[..., :3, :3]
    tensor = _trace(second_moment) * np.eye(3) - second_moment
    mass, first_moment = pseudo[..., 3, 3:], pseudo[..., :3, 3]
    return np.concatenate([mass, first_moment, tensor[..., *np.triu_indices(3)]], axis=-1)


def _trace(matrices: np.ndarray) -> np.ndarray:
    """Return traces (..., 1, 1) of (..., 3, 3)."""
    result: np.ndarray = np.trace(matrices, axis1=-2, axis2=-1)[..., None, None]
    return result


def reference_factor(parameters: np.ndarray) -> tuple[np.ndarray, bool]:
    """Return C (4, 4) with C C^T = J of a body, and whether the body is a possible one.

    For one that is not, J is the nearest that is, its least eigenvalues raised.
    """
    pseudo = pseudo_inertia(parameters)
    # URDFs with impossible inertias still need a start: the nearest possible body
    values, vectors = np.linalg.eigh(pseudo)
    least = TUNING.least_pseudo_eigenvalue * values[-1]
    possible = bool(values[0] > least * TUNING.least_pseudo_eigenvalue)
    if not possible:
        pseudo = (vectors * np.maximum(values, least)) @ vectors.T
    return np.linalg.cholesky(pseudo), possible
