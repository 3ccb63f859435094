"""What the URDF's own values say about sizes: where the model's numbers start and how they are scaled.

Nothing here has to be right for the model to be: a URDF without inertials, or with impossible ones, is
replaced by one-kilogram links.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import floor, log10, pi

import numpy as np

from spelgen.arm.arm import Arm, Coordinate
from spelgen.structure.basis import Weights
from spelgen.structure.recursion import triangle
from spelgen.structure.sampling import float_energies
from spelgen.structure.structure import Structure

_POINTS = 512
_DIGITS = 6
_LEAST_SIZE = 0.05
"""An output that the nominal values hardly move is still allowed this fraction of the entries it enters."""
_LEAST_SENSITIVITY = 0.02
"""A joint that M or V hardly depends on nominally is still seen by the network at this sensitivity."""

_DEFAULT_MASS = 1.0  # kg
_DEFAULT_GYRATION = 0.1  # m


@dataclass(frozen=True)
class Nominal:
    """Sizes over the arm's workspace, rounded to six digits so that they are the same on every machine.

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
    """Nominal sizes of ``arm`` in terms of ``structure``'s outputs and constants."""
    rng = np.random.default_rng(0)
    q = np.stack([rng.uniform(*working_range(c), _POINTS) for c in arm.coordinates], axis=-1)
    mass, from_urdf = _mass_samples(arm, q)
    inertias = nominal_inertias(arm, from_urdf)
    keys = triangle(len(arm.coordinates))
    means = mass.mean(axis=0)
    typical = np.sqrt([means[keys.index((i, i))] * means[keys.index((j, j))] for i, j in keys])
    outputs = mass @ _matrix(structure, [output.reads for output in structure.outputs]).T
    output_sizes = [_LEAST_SIZE * _size(typical, keys, output.reads) for output in structure.outputs]
    constants = means @ _matrix(structure, [constant.reads for constant in structure.constants]).T
    constant_sizes = [_LEAST_SIZE * _size(typical, keys, constant.reads) for constant in structure.constants]
    torque = _gravity_torque(arm, q, inertias)
    changes = _mass_changes(arm, q, inertias, typical)
    inertial = np.sqrt((mass[:, [keys.index((i, i)) for i in range(q.shape[1])]] ** 2).mean(axis=0))
    _, potential = float_energies(arm, q, inertias)
    return Nominal(
        output_means=_rounded(outputs.mean(axis=0)),
        output_scales=_rounded(np.maximum(outputs.std(axis=0), output_sizes)),
        constants=_rounded(constants),
        constant_scales=_rounded(np.maximum(np.abs(constants), constant_sizes)),
        potential_scale=_rounded([max(float(potential.std()), 1e-3)])[0],
        joint_torque=_rounded(np.hypot(torque, inertial)),
        mass_sensitivities=_sensitivities(changes),
        potential_sensitivities=_sensitivities(torque),
        least_eigenvalue=_rounded([_least_eigenvalue(mass, means, q.shape[1])])[0],
        from_urdf=from_urdf,
    )


def working_range(coordinate: Coordinate) -> tuple[float, float]:
    """The range a coordinate is taken to move in: its limits where they are usable, else one turn or one
    metre.
    """
    lower, upper = coordinate.lower, coordinate.upper
    if coordinate.continuous or lower is None or upper is None or not 0 < upper - lower < 1e3:
        return (-pi, pi) if coordinate.kind == "revolute" else (-0.5, 0.5)
    return (max(lower, -2 * pi), min(upper, 2 * pi)) if coordinate.kind == "revolute" else (lower, upper)


def _mass_samples(arm: Arm, q: np.ndarray) -> tuple[np.ndarray, bool]:
    """Lower triangles of M at ``q``, and whether the URDF's inertials gave them."""
    if arm.has_inertials:
        mass, _ = float_energies(arm, q, nominal_inertias(arm, True))
        if _least_eigenvalue(mass, mass.mean(axis=0), q.shape[1]) > 1e-6:
            return mass, True
    return float_energies(arm, q, nominal_inertias(arm, False))[0], False


def nominal_inertias(arm: Arm, from_urdf: bool) -> list[list[float]]:
    """Ten inertial parameters by body: the URDF's, or those of one-kilogram balls."""
    if from_urdf:
        return [[float(x) for x in body.inertia or ()] for body in arm.bodies]
    return [_default_inertia(arm, index) for index in range(len(arm.bodies))]


def _default_inertia(arm: Arm, index: int) -> list[float]:
    """A one-kilogram ball half-way to the next joint, or 0.1 m out along x and z where there is none."""
    followers = [body.translation for body in arm.bodies if body.parent == index]
    center = np.array([float(x) / 2 for x in followers[0]]) if followers else np.zeros(3)
    if np.linalg.norm(center) < _DEFAULT_GYRATION:
        center = np.array([_DEFAULT_GYRATION, 0.0, _DEFAULT_GYRATION])
    tensor = _DEFAULT_MASS * ((_DEFAULT_GYRATION**2 + center @ center) * np.eye(3) - np.outer(center, center))
    return [_DEFAULT_MASS, *(_DEFAULT_MASS * center), *tensor[np.triu_indices(3)]]


def _least_eigenvalue(mass: np.ndarray, mean: np.ndarray, n: int) -> float:
    """Least eigenvalue, over the samples, of M relative to ``mean``; 0 where the mean is not positive
    definite.
    """
    full = np.zeros((len(mass) + 1, n, n))
    rows, columns = np.tril_indices(n)
    full[:, rows, columns] = full[:, columns, rows] = np.concatenate([mass, mean[None]])
    if np.linalg.eigvalsh(full[-1])[0] <= 0:
        return 0.0
    whitening = np.linalg.inv(np.linalg.cholesky(full[-1]))
    return float(np.linalg.eigvalsh(whitening @ full[:-1] @ whitening.T)[:, 0].min())


def _gravity_torque(arm: Arm, q: np.ndarray, inertias: list[list[float]]) -> np.ndarray:
    """Root mean square of dV/dq by coordinate."""
    step = 1e-4
    shifts = step * np.eye(q.shape[1])[:, None]
    ahead, behind = (_energies_of_each(arm, q + sign * shifts, inertias)[1] for sign in (1, -1))
    return np.sqrt(
        [(((after - before) / (2 * step)) ** 2).mean() for after, before in zip(ahead, behind, strict=True)]
    )


def _mass_changes(arm: Arm, q: np.ndarray, inertias: list[list[float]], typical: np.ndarray) -> np.ndarray:
    """Root mean square change of M's entries, relative to their typical size, when a coordinate moves
    elsewhere.
    """
    base, _ = float_energies(arm, q, inertias)
    moved = np.stack([q] * q.shape[1])
    for index in range(q.shape[1]):
        moved[index, :, index] = np.roll(q[:, index], 1)
    elsewhere, _ = _energies_of_each(arm, moved, inertias)
    return np.sqrt([(((mass - base) / typical) ** 2).mean() for mass in elsewhere])


def _energies_of_each(arm: Arm, q: np.ndarray, inertias: list[list[float]]) -> tuple[np.ndarray, np.ndarray]:
    """``float_energies`` of sets (n, points, n) of positions, (n, points, n(n+1)/2) and (n, points), in one call."""
    mass, potential = float_energies(arm, q.reshape(-1, q.shape[-1]), inertias)
    return mass.reshape(*q.shape[:2], -1), potential.reshape(q.shape[:2])


def _sensitivities(sizes: np.ndarray) -> tuple[float, ...]:
    """Sizes relative to the largest, but at least ``_LEAST_SENSITIVITY``."""
    largest = sizes.max()
    return _rounded(
        np.maximum(sizes / largest, _LEAST_SENSITIVITY) if largest > 0 else np.ones_like(sizes), 3
    )


def _matrix(structure: Structure, reads: Sequence[Weights]) -> np.ndarray:
    keys = {key: index for index, key in enumerate(triangle(len(structure.joints)))}
    matrix = np.zeros((len(reads), len(keys)))
    for row, weights in enumerate(reads):
        for i, j, value in weights:
            matrix[row, keys[i, j]] = float(value)
    return matrix


def _size(typical: np.ndarray, keys: list[tuple[int, int]], reads: Weights) -> float:
    return float(sum(abs(value) * typical[keys.index((i, j))] for i, j, value in reads))


def _rounded(values: Sequence[float] | np.ndarray, digits: int = _DIGITS) -> tuple[float, ...]:
    return tuple(_round(float(value), digits) for value in values)


def _round(value: float, digits: int) -> float:
    if abs(value) < 1e-12:
        return 0.0
    return round(value, digits - 1 - floor(log10(abs(value))))
