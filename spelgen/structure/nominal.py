"""Derive from the URDF's own values where the model's numbers start and how they are scaled.

Nothing here has to be right for the model to be: a URDF without inertials, or with impossible ones, is
replaced by one-kilogram links.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from math import floor, isqrt, log10, pi

import numpy as np

from spelgen.arm.arm import Arm, Coordinate
from spelgen.structure.basis import Term, row_of
from spelgen.structure.sampling import float_energies
from spelgen.structure.structure import Structure
from spelgen.structure.tuning import TUNING

_DIGITS = 6


@dataclass(frozen=True)
class Nominal:
    """Hold sizes over the arm's workspace, rounded to six digits so that they are the same on every machine.

    ``output_*`` go by the structure's outputs, ``constants`` by its constants, ``joint_torque`` [Nm, N] by
    coordinate.
    """

    output_means: tuple[float, ...]
    output_scales: tuple[float, ...]
    constants: tuple[float, ...]
    constant_scales: tuple[float, ...]
    potential_scale: float
    joint_torque: tuple[float, ...]
    mass_sensitivities: tuple[float, ...]
    potential_sensitivities: tuple[float, ...]
    least_eigenvalue: float
    """Least eigenvalue of M(q) relative to the mean M, over the workspace."""
    from_urdf: bool
    """Whether the URDF's inertials were usable."""


def nominal(arm: Arm, structure: Structure) -> Nominal:
    """Return nominal sizes of ``arm`` in terms of ``structure``'s outputs and constants."""
    # a fixed seed: these numbers stand in the emitted source, which must not change
    rng = np.random.default_rng(0)
    ranges = list(map(working_range, arm.coordinates))
    q = np.stack([rng.uniform(lower, upper, TUNING.points) for lower, upper in ranges], axis=-1)
    from_urdf = arm.has_inertials and _gives_usable_mass(arm, q)
    inertias = nominal_inertias(arm, from_urdf)
    # over the workspace: at zero position many couplings happen to vanish
    mass, potential = float_energies(arm, q, inertias)
    means = mass.mean(axis=0)
    rows, columns = np.tril_indices(len(ranges))
    diagonal = rows == columns
    # an entry off the diagonal is at most this, as M is positive definite (Cauchy and Schwarz)
    typical = np.sqrt(means[diagonal][rows] * means[diagonal][columns])
    output_reads = _reads(structure.outputs, len(ranges))
    constant_reads = _reads(structure.constants, len(ranges))
    outputs = mass @ output_reads.T
    constants = constant_reads @ means
    # an output that the nominal values hardly move still moves by a part of the entries it enters
    output_floor = TUNING.least_size * (np.abs(output_reads) @ typical)
    constant_floor = TUNING.least_size * (np.abs(constant_reads) @ typical)
    torque = _gravity_torque(arm, q, inertias)
    inertial = np.sqrt((mass[:, diagonal] ** 2).mean(axis=0))
    return Nominal(
        output_means=_rounded(outputs.mean(axis=0)),
        output_scales=_rounded(np.maximum(outputs.std(axis=0), output_floor), least=0.0),
        constants=_rounded(constants),
        constant_scales=_rounded(np.maximum(np.abs(constants), constant_floor), least=0.0),
        potential_scale=_round(max(float(potential.std()), 1e-3), _DIGITS),
        joint_torque=_rounded(np.hypot(torque, inertial)),
        mass_sensitivities=_sensitivities(_mass_changes(arm, q, inertias, mass, typical)),
        potential_sensitivities=_sensitivities(torque),
        least_eigenvalue=_round(_least_eigenvalue(mass), _DIGITS),
        from_urdf=from_urdf,
    )


def working_range(coordinate: Coordinate) -> tuple[float, float]:
    """Return the range a coordinate is taken to move in: its usable limits, else one turn or one metre."""
    lower, upper = coordinate.lower, coordinate.upper
    turns = coordinate.kind == "revolute"
    if coordinate.continuous or lower is None or upper is None or not 0 < upper - lower < 1e3:
        reach = pi if turns else 0.5
        return -reach, reach
    if turns:
        return max(lower, -2 * pi), min(upper, 2 * pi)
    return lower, upper


def _reads(terms: Sequence[Term], n: int) -> np.ndarray:
    """Return the weights of M's entries in terms of its smallest form, a row each."""
    rows = [row_of(term.reads, n) for term in terms]
    return np.reshape(rows, (-1, n * (n + 1) // 2))


def _gives_usable_mass(arm: Arm, q: np.ndarray) -> bool:
    """Whether the URDF's inertials give every joint something to carry, and M positive definite."""
    mass, _ = float_energies(arm, q, nominal_inertias(arm, True))
    rows, columns = np.tril_indices(q.shape[1])
    lightest = mass.mean(axis=0)[rows == columns].min()
    # a joint that carries 1e-12 kg carries a placeholder, which rounding takes for zero
    return bool(lightest > 1e-11 and _least_eigenvalue(mass) > 1e-6)


def nominal_inertias(arm: Arm, from_urdf: bool) -> list[list[float]]:
    """Return ``exact_inertias`` as floats."""
    return [list(map(float, ten)) for ten in exact_inertias(arm, from_urdf)]


def exact_inertias(arm: Arm, from_urdf: bool) -> Sequence[Sequence[Fraction | float]]:
    """Return ten inertial parameters per body: those of the URDF, exact, or those of balls of 1 kg."""
    if from_urdf:
        return [body.inertia or () for body in arm.bodies]
    return [_default_inertia(arm, index) for index in range(len(arm.bodies))]


def _default_inertia(arm: Arm, index: int) -> list[float]:
    """Return a one-kilogram ball half-way to the next joint, or 0.1 m out along x and z where there is none."""
    gyration = TUNING.default_gyration
    center = np.zeros(3)
    for body in reversed(arm.bodies):
        if body.parent == index:
            center = np.array(body.translation, dtype=float) / 2
    # a centre on the axis would give the joint no gravity and no coupling at all
    if np.linalg.norm(center) < gyration:
        center = np.array([gyration, 0.0, gyration])
    tensor = (gyration**2 + center @ center) * np.eye(3) - np.outer(center, center)
    return [1.0, *center, *tensor[np.triu_indices(3)]]


def _least_eigenvalue(mass: np.ndarray) -> float:
    """Return the least eigenvalue, over the samples, of M relative to its mean, 0 where that is not definite."""
    triangles = np.concatenate([mass, mass.mean(axis=0, keepdims=True)])
    n = isqrt(2 * triangles.shape[1])
    matrices = np.zeros((len(triangles), n, n))
    rows, columns = np.tril_indices(n)
    matrices[:, rows, columns] = matrices[:, columns, rows] = triangles
    samples, reference = matrices[:-1], matrices[-1]
    if np.linalg.eigvalsh(reference)[0] <= 0:
        return 0.0
    # relative to the mean M: eigenvalues of M itself mix kilograms and kilogram square metres
    whitening = np.linalg.inv(np.linalg.cholesky(reference))
    eigenvalues = np.linalg.eigvalsh(whitening @ samples @ whitening.T)
    return float(eigenvalues.min())


def _gravity_torque(arm: Arm, q: np.ndarray, inertias: list[list[float]]) -> np.ndarray:
    """Return the root mean square of dV/dq by coordinate."""
    step = 1e-4  # [rad, m] central differences: errors of 1e-8 do, these are sizes
    shifts = step * np.eye(q.shape[1])[:, None]
    _, forward = float_energies(arm, q + shifts, inertias)
    _, backward = float_energies(arm, q - shifts, inertias)
    slopes = (forward - backward) / (2 * step)
    result: np.ndarray = np.sqrt((slopes**2).mean(axis=1))
    return result


def _mass_changes(
    arm: Arm, q: np.ndarray, inertias: list[list[float]], mass: np.ndarray, typical: np.ndarray
) -> np.ndarray:
    """Return the root mean square change of M's entries, relative to their typical size, as each coordinate moves."""
    moved = np.stack([q] * q.shape[1])
    for index in range(q.shape[1]):
        moved[index, :, index] = np.roll(q[:, index], 1)  # to where it stands in another sample
    moved_mass, _ = float_energies(arm, moved, inertias)
    result: np.ndarray = np.sqrt((((moved_mass - mass) / typical) ** 2).mean(axis=(1, 2)))
    return result


def _sensitivities(sizes: np.ndarray) -> tuple[float, ...]:
    """Return sizes relative to the largest, but at least so that the network still sees the joint."""
    if sizes.max() <= 0:
        return (1.0,) * len(sizes)
    return _rounded(np.maximum(sizes / sizes.max(), TUNING.least_sensitivity), 3)


def _rounded(values: np.ndarray, digits: int = _DIGITS, least: float = 1e-12) -> tuple[float, ...]:
    return tuple(_round(value, digits, least) for value in values.tolist())


def _round(value: float, digits: int, least: float = 1e-12) -> float:
    """Return a number of so many significant digits, so that it is the same on every machine; 0 for a smaller one.

    What models divide by, as an arm of 1e-12 kg gives, has no least.
    """
    if abs(value) <= least:
        return 0.0
    return round(value, digits - 1 - floor(log10(abs(value))))
