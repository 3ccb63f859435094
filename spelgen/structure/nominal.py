"""Nominal values of an arm, from the inertials of the URDF: initial values and scales of a model's functions.

Nominal values are means and standard deviations of M, V and torques over random positions. They affect the training of
a model, not its structure. If the inertials of a URDF are absent or physically inconsistent, default bodies of 1 kg are
used.

The ten inertial parameters of a body are mass m, first moment h and inertia I. They are physically consistent, that is,
belong to a distribution of mass, if and only if the pseudo-inertia J = [[S, h], [h^T, m]] is positive definite. S =
tr(I)/2 E - I, with the identity matrix E (Wensing, Kim and Slotine, IEEE RA-L 3:60, 2018).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from math import floor, isqrt, log10

import numpy as np

from spelgen.arm.arm import Chain
from spelgen.structure.basis import Term, row_of
from spelgen.structure.sampling import float_energies
from spelgen.structure.structure import Structure


@dataclass(frozen=True)
class Nominal:
    """Typical values of M, V and torques of an arm, from which a model gets its initial values and scales.

    They are computed over random positions in the joint ranges, for the bodies of the URDF or default bodies, and
    rounded to six digits for reproducibility across machines.

    Attributes:
        output_means: mean of the function f_j(q) of each varying term of M (see `structure.basis`).
        output_scales: standard deviation of each f_j(q), with a lower bound.
        constants: value of each constant c_k of M.
        constant_scales: magnitude of each constant, with a lower bound.
        potential_scale: standard deviation of V [J].
        joint_torque: typical torque of each coordinate [Nm, N]: sqrt(g^2 + a^2) with the root mean squares g of the
            gravity torque and a of the torque for unit acceleration.
        mass_sensitivities: root mean square change of M if only this coordinate changes (`_mass_changes`), divided by
            the largest value of all coordinates; at least 0.02.
        potential_sensitivities: root mean square of dV/dq, normalised in the same way.
    """

    output_means: tuple[float, ...]
    output_scales: tuple[float, ...]
    constants: tuple[float, ...]
    constant_scales: tuple[float, ...]
    potential_scale: float
    joint_torque: tuple[float, ...]
    mass_sensitivities: tuple[float, ...]
    potential_sensitivities: tuple[float, ...]
    min_eigenvalue: float
    """Smallest generalised eigenvalue of M(q) relative to the mean of M, over random positions."""
    from_urdf: bool
    """True if the values are computed from the inertials of the URDF; False: from default bodies."""


def nominal(arm: Chain, structure: Structure) -> Nominal:
    """Return typical values of M, V and torques of an arm, by which models are scaled.

    They are means, standard deviations and root mean squares over random positions (see `Nominal`). structure: terms of
    M = sum_k c_k A_k + sum_j f_j(q) B_j, with constants c_k, functions f_j and constant matrices A_k and B_j.
    """
    # The seed is constant, because nominal values are part of the emitted module, which must be reproducible.
    rng = np.random.default_rng(0)
    ranges = [x.working_range for x in arm.coordinates]
    q = np.stack([rng.uniform(lower, upper, 512) for lower, upper in ranges], axis=-1)
    from_urdf = arm.inertials_complete and _gives_usable_mass(arm, q)
    inertias = nominal_inertias(arm, from_urdf)
    # M is averaged over random positions, because many of its off-diagonal entries vanish at zero position.
    mass, potential = float_energies(arm, q, inertias)
    means = mass.mean(axis=0)
    rows, columns = np.tril_indices(len(ranges))
    diagonal = rows == columns
    # The typical magnitude of an entry of M is its bound: |M_ij| <= sqrt(M_ii M_jj), because M is positive definite.
    typical = np.sqrt(means[diagonal][rows] * means[diagonal][columns])
    output_rows = _functionals(structure.outputs, len(ranges))
    constant_rows = _functionals(structure.constants, len(ranges))
    outputs = mass @ output_rows.T
    constants = constant_rows @ means
    # Scales have lower bounds, since they are divisors, and a term of M that is almost constant (or zero) for the
    # inertials of the URDF may vary for the true inertials.
    output_floor = 0.05 * (np.abs(output_rows) @ typical)
    constant_floor = 0.05 * (np.abs(constant_rows) @ typical)
    # `torque` and `inertial` are the torques that a joint's drive needs for gravity and for unit acceleration; friction
    # is scaled by them.
    torque = _gravity_torque(arm, q, inertias)
    inertial = np.sqrt((mass[:, diagonal] ** 2).mean(axis=0))
    return Nominal(
        output_means=_rounded(outputs.mean(axis=0)),
        output_scales=_rounded(np.maximum(outputs.std(axis=0), output_floor), zero_below=0.0),
        constants=_rounded(constants),
        constant_scales=_rounded(np.maximum(np.abs(constants), constant_floor), zero_below=0.0),
        # V is determined up to a constant: its scale is its standard deviation, not its magnitude.
        potential_scale=_round(max(float(potential.std()), 1e-3)),
        joint_torque=_rounded(np.hypot(torque, inertial)),
        mass_sensitivities=_sensitivities(_mass_changes(arm, q, inertias, mass, typical)),
        potential_sensitivities=_sensitivities(torque),
        min_eigenvalue=_round(_min_eigenvalue(mass)),
        from_urdf=from_urdf,
    )


def _functionals(terms: Sequence[Term], n: int) -> np.ndarray:
    """Return the weights, (m, n(n+1)/2), with which the functions f of m terms are computed from M (`Term.functional`).

    f is the sum of weight times entry over the lower triangle of M; the columns are the entries, row after row.
    """
    rows = [row_of(term.functional, n) for term in terms]
    return np.reshape(rows, (-1, n * (n + 1) // 2))


def _gives_usable_mass(arm: Chain, q: np.ndarray) -> bool:
    """Return True if, with the inertials of the URDF, every joint moves a mass and M is positive definite.

    M is tested at S positions q, (S, n) [rad, m].
    """
    mass, _ = float_energies(arm, q, nominal_inertias(arm, True))
    rows, columns = np.tril_indices(q.shape[1])
    lightest = mass.mean(axis=0)[rows == columns].min()
    # Some URDFs have masses of 1e-12 kg as placeholders; M would then be of the order of rounding errors.
    return bool(lightest > 1e-11 and _min_eigenvalue(mass) > 1e-6)


def nominal_inertias(arm: Chain, from_urdf: bool) -> list[list[float]]:
    """Return the result of `exact_inertias` as floats: the ten inertial parameters of each body.

    from_urdf: True: values of the URDF; False: default bodies of 1 kg.
    """
    return [list(map(float, ten)) for ten in exact_inertias(arm, from_urdf)]


def exact_inertias(arm: Chain, from_urdf: bool) -> Sequence[Sequence[Fraction | float]]:
    """Return the mass, first moment and inertia (10 numbers) of each body, about the origin of its joint frame.

    from_urdf: True: exact values of the URDF; False: default bodies of 1 kg.
    """
    if from_urdf:
        return [body.inertia or () for body in arm.bodies]
    return [_default_inertia(arm, index) for index in range(len(arm.bodies))]


def _default_inertia(arm: Chain, index: int) -> list[float]:
    """Return the inertial parameters of a default body: a sphere of 1 kg, with 0.1 m radius of gyration.

    They are mass, first moment and inertia about the origin of the joint frame of body ``index``. The centre of the
    sphere is half-way to the next joint. For the last body, or if the next joint is closer than 0.2 m, the centre is at
    (0.1, 0, 0.1) m in the joint frame.
    """
    gyration = 0.1  # [m] radius of gyration of a default body
    center = np.zeros(3)
    for body in reversed(arm.bodies):
        if body.parent == index:
            center = np.array(body.translation, dtype=float) / 2
    # A centre of mass close to the joint axis would cause neither gravity torque nor coupling between joints.
    if np.linalg.norm(center) < gyration:
        center = np.array([gyration, 0.0, gyration])
    tensor = (gyration**2 + center @ center) * np.eye(3) - np.outer(center, center)
    return [1.0, *center, *tensor[np.triu_indices(3)]]


def _min_eigenvalue(mass: np.ndarray) -> float:
    """Return the smallest eigenvalue of M, relative to the mean of M, over S samples (generalised eigenvalue).

    It is positive if all samples of M are positive definite, and 0 if their mean is not positive definite. mass: lower
    triangles of M, (S, n(n+1)/2).
    """
    n = isqrt(2 * mass.shape[1])
    matrices = np.zeros((len(mass), n, n))
    rows, columns = np.tril_indices(n)
    matrices[:, rows, columns] = matrices[:, columns, rows] = mass
    reference = matrices.mean(axis=0)
    if np.linalg.eigvalsh(reference)[0] <= 0:
        return 0.0
    # Generalised eigenvalues (relative to the mean of M) have no unit; eigenvalues of M would mix kg and kg m2.
    whitening = np.linalg.inv(np.linalg.cholesky(reference))
    eigenvalues = np.linalg.eigvalsh(whitening @ matrices @ whitening.T)
    return float(eigenvalues.min())


def _gravity_torque(arm: Chain, q: np.ndarray, inertias: list[list[float]]) -> np.ndarray:
    """Return the root mean square over S positions q, (S, n), of the gravity torque dV/dq, (n,) [Nm, N].

    inertias: ten inertial parameters of each body.
    """
    # [rad, m] Step of the central differences for dV/dq. The derivative has a relative error of 1e-8, which is small
    # enough for scales.
    step = 1e-4
    shifts = step * np.eye(q.shape[1])[:, None]
    _, forward = float_energies(arm, q + shifts, inertias)
    _, backward = float_energies(arm, q - shifts, inertias)
    gradient = (forward - backward) / (2 * step)
    return np.asarray(np.sqrt((gradient**2).mean(axis=1)))


def _mass_changes(
    arm: Chain, q: np.ndarray, inertias: list[list[float]], mass: np.ndarray, typical: np.ndarray
) -> np.ndarray:
    """Return, for each coordinate, the root mean square change of M if only this coordinate changes, (n,).

    The coordinate changes from one random value to another: to its value in the preceding sample. The change of an
    entry of M is divided by the typical magnitude of the entry, so that it has no unit. The mean is over samples and
    entries.

    Args:
        arm: the arm.
        q: S random positions, (S, n) [rad, m].
        inertias: ten inertial parameters of each body.
        mass: lower triangles of M at q, (S, n(n+1)/2).
        typical: magnitudes of the entries of M, (n(n+1)/2,), by which the changes are divided.
    """
    moved = np.stack([q] * q.shape[1])
    for index in range(q.shape[1]):
        # Coordinate `index` gets its value in the preceding sample; all other coordinates are unchanged.
        moved[index, :, index] = np.roll(q[:, index], 1)
    moved_mass, _ = float_energies(arm, moved, inertias)
    return np.asarray(np.sqrt((((moved_mass - mass) / typical) ** 2).mean(axis=(1, 2))))


def _sensitivities(magnitudes: np.ndarray) -> tuple[float, ...]:
    """Return the magnitudes of the effects of all coordinates on M or V, (n,), divided by the largest, at least 0.02.

    The results are factors of the inputs of networks; with the lower bound, every joint is an input.
    """
    if magnitudes.max() <= 0:
        return (1.0,) * len(magnitudes)
    return _rounded(np.maximum(magnitudes / magnitudes.max(), 0.02), 3)


def _rounded(values: np.ndarray, digits: int = 6, zero_below: float = 1e-12) -> tuple[float, ...]:
    """Return the values, (n,), each rounded to ``digits`` significant digits; magnitudes up to ``zero_below`` are 0."""
    return tuple(_round(value, digits, zero_below) for value in values.tolist())


def _round(value: float, digits: int = 6, zero_below: float = 1e-12) -> float:
    """Return a value rounded to ``digits`` significant digits, so that results are equal on all machines.

    Magnitudes up to ``zero_below`` become 0. Scales are rounded with ``zero_below`` = 0, because scales are divisors:
    they must not become 0, even for an arm of 1e-12 kg.
    """
    if abs(value) <= zero_below:
        return 0.0
    return round(value, digits - 1 - floor(log10(abs(value))))


def pseudo_inertia(parameters: np.ndarray) -> np.ndarray:
    """Return pseudo-inertias J, (..., 4, 4), of inertial parameters (m, h, I), (..., 10).

    m: mass; h: first moment; I: inertia about the origin, in the order of ``Body.inertia``.
    """
    values = np.asarray(parameters, dtype=float)
    tensor = np.zeros((*values.shape[:-1], 3, 3))
    rows, columns = np.triu_indices(3)
    tensor[..., rows, columns] = tensor[..., columns, rows] = values[..., 4:]
    pseudo = np.zeros((*values.shape[:-1], 4, 4))
    # The inertia tensor is I = tr(S) E - S for second moments of mass S and the identity E: hence S = tr(I)/2 E - I.
    pseudo[..., :3, :3] = _trace(tensor) / 2 * np.eye(3) - tensor
    pseudo[..., :3, 3] = pseudo[..., 3, :3] = values[..., 1:4]
    pseudo[..., 3, 3] = values[..., 0]
    return pseudo


def parameters_of(pseudo: np.ndarray) -> np.ndarray:
    """Return the inertial parameters (m, h, I), (..., 10), of pseudo-inertias, (..., 4, 4).

    It is the inverse of `pseudo_inertia`.
    """
    second_moment = pseudo[..., :3, :3]
    tensor = _trace(second_moment) * np.eye(3) - second_moment
    mass, first_moment = pseudo[..., 3, 3:], pseudo[..., :3, 3]
    return np.concatenate([mass, first_moment, tensor[..., *np.triu_indices(3)]], axis=-1)


def _trace(matrices: np.ndarray) -> np.ndarray:
    """Return the traces, (..., 1, 1), of matrices, (..., 3, 3)."""
    return np.asarray(np.trace(matrices, axis1=-2, axis2=-1)[..., None, None])


def reference_factor(parameters: np.ndarray) -> tuple[np.ndarray, bool]:
    """Return the Cholesky factor of a body's pseudo-inertia J, made physically consistent if necessary.

    Args:
        parameters: mass, first moment and inertia (m, h, I) of a body, (10,) [kg, kg m, kg m^2].

    Returns:
        Lower triangular C, (4, 4), with C C^T = J, and True if the parameters are consistent. If they are inconsistent,
        the smallest eigenvalues of J are raised before the factorisation.
    """
    pseudo = pseudo_inertia(parameters)
    values, vectors = np.linalg.eigh(pseudo)
    # [1] An inconsistent pseudo-inertia J is corrected: its smallest eigenvalue becomes `fraction` times the largest
    # one. J counts as inconsistent only if the ratio of these eigenvalues is below fraction^2: the ratio of a slender
    # body may be below `fraction`, although the body is consistent.
    fraction = 1e-4
    min_eigenvalue = fraction * values[-1]
    is_consistent = bool(values[0] > min_eigenvalue * fraction)
    if not is_consistent:
        pseudo = (vectors * np.maximum(values, min_eigenvalue)) @ vectors.T
    return np.linalg.cholesky(pseudo), is_consistent
