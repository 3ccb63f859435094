"""Physical consistency of inertial parameters, from the 4 x 4 pseudo-inertia of a body.

Ten parameters (m, h, I) are physically consistent, that is, belong to a distribution of mass, if and only if
J = [[S, h], [h^T, m]] with S = tr(I)/2 1 - I is positive definite (Wensing, Kim and Slotine, IEEE RA-L 3:60, 2018).
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
    # The second moments of mass S from the inertia tensor I = tr(S) 1 - S.
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
    """Return the Cholesky factor of a consistent pseudo-inertia, and whether the parameters are consistent.

    Args:
        parameters: (m, h, I) of a body, (10,) [kg, kg m, kg m2].

    Returns:
        C (4, 4) with C C^T = J. If the parameters are inconsistent, the smallest eigenvalues of J are raised.
    """
    pseudo = pseudo_inertia(parameters)
    values, vectors = np.linalg.eigh(pseudo)
    min_eigenvalue = TUNING.min_pseudo_eigenvalue * values[-1]
    is_consistent = bool(values[0] > min_eigenvalue * TUNING.min_pseudo_eigenvalue)
    if not is_consistent:
        pseudo = (vectors * np.maximum(values, min_eigenvalue)) @ vectors.T
    return np.linalg.cholesky(pseudo), is_consistent
