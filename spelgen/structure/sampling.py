"""Sample mass matrices and potential energies of an arm, and find the spans that decide the arm's structure.

Points are random, in the prime field and in floating point.

Both kinds of sample come as a base block and, for every coordinate, a block in which that coordinate alone
has moved: what changes between the two depends on the coordinate.
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from spelgen.arm.arm import Arm
from spelgen.structure import field
from spelgen.structure.field import (
    PRIME,
    Residues,
    difference,
    random_circle_points,
    random_residues,
    residue,
)
from spelgen.structure.recursion import Element, Position, base_denominators, coefficients, energies, triangle
from spelgen.structure.tuning import TUNING

if TYPE_CHECKING:
    from spelgen.urdf.robot import Assume

Ten = Sequence[Element]


def field_samples(arm: Arm, assume: Assume, samples: int) -> tuple[np.ndarray, np.ndarray]:
    """Return M, (1 + n, samples, n(n+1)/2), and V, (1 + n, samples), in the field of 2^61 - 1.

    Block 0 is the base, block k has coordinate k moved. Under ``kinematics`` every sample has inertial parameters of
    its own.
    """
    rng = np.random.default_rng(0)
    n = len(arm.coordinates)
    positions = []
    for index in range(n):
        # an angle's cosine and sine and a sliding distance are independent as functions, so each is drawn for
        # itself
        c, s = random_circle_points(rng, 2 * samples)
        value = random_residues(rng, (2 * samples,))
        moved = [Residues(_one_moved(x, index, 1 + n)) for x in (c, s, value)]
        positions.append(Position(*moved))
    inertias: list[Ten] = []
    for body in arm.bodies:
        # what holds for random inertial values of each sample holds for any of them
        if assume == "kinematics":
            inertias.append(list(map(Residues, random_residues(rng, (10, samples)))))
        else:
            inertias.append(list(map(residue, body.inertia or (Fraction(0),) * 10)))
    result = energies(arm, positions, inertias, residue)
    shape = (1 + n, samples)
    entries = [_residue_values(entry, shape) for entry in result.mass.values()]
    return np.stack(entries, axis=-1), _residue_values(result.potential, shape)


def regressor_rows(arm: Arm, points: int) -> np.ndarray:
    """Return rows of the energy regressor in the field, ((n(n+1)/2 + 1) points, 10 bodies).

    M(q) and V(q) - V(q0) are linear in the inertial parameters and fix the torque, so the rows' rank is
    the number of base parameters (Gautier and Khalil 1990).
    """
    rng = np.random.default_rng(1)
    parameters = 10 * len(arm.bodies)
    positions = []
    for _ in arm.coordinates:
        c, s = random_circle_points(rng, points)
        value = random_residues(rng, (points,))
        columns = [Residues(x[:, None]) for x in (c, s, value)]
        positions.append(Position(*columns))
    units = list(map(Residues, np.eye(parameters, dtype=np.uint64)))
    elements = coefficients(arm, positions, units, residue)
    rows = np.stack([_residue_values(element, (points, parameters)) for element in elements], axis=1)
    # V counts up to a constant: its first row is where it counts from
    rows[:, -1] = difference(rows[:, -1], rows[0, -1])
    return rows.reshape(-1, parameters)


def float_samples(arm: Arm, assume: Assume, samples: int, seed: int = 2) -> np.ndarray:
    """Return the same kind of samples of M in double precision."""
    rng = np.random.default_rng(seed)
    n = len(arm.coordinates)
    q = [_one_moved(rng.uniform(-3.0, 3.0, 2 * samples), index, 1 + n) for index in range(n)]
    inertias: list[Ten] = []
    for body in arm.bodies:
        if assume == "kinematics":
            inertias.append(list(rng.normal(size=(10, samples))))
        else:
            inertias.append(list(map(float, body.inertia or (0,) * 10)))
    mass, _ = float_energies(arm, np.stack(q, axis=-1), inertias)
    return mass


def float_energies(arm: Arm, q: np.ndarray, inertias: Sequence[Ten]) -> tuple[np.ndarray, np.ndarray]:
    """Return lower triangles of M, (..., n(n+1)/2), and V [J], (...), at ``q`` (..., n) [rad, m], real or complex."""
    positions = []
    for index, base in enumerate(base_denominators(arm)):
        value = q[..., index]
        positions.append(Position(np.cos(value / base), np.sin(value / base), value))
    result = energies(arm, positions, inertias, float)
    shape = np.broadcast_shapes(q.shape[:-1], *map(np.shape, inertias[0]))
    entries = [np.broadcast_to(entry, shape) for entry in result.mass.values()]
    potential = np.broadcast_to(result.potential, shape)
    return np.stack(entries, axis=-1).astype(q.dtype), potential.astype(q.dtype)


def _one_moved(values: np.ndarray, index: int, blocks: int) -> np.ndarray:
    """Return the first half of ``values`` in every block, but the second half in coordinate ``index``'s own."""
    base, moved = np.split(values, 2)
    result = np.tile(base, (blocks, 1))
    result[index + 1] = moved
    return result


def _residue_values(element: Residues | int, shape: tuple[int, ...]) -> np.ndarray:
    """Return an element of the ring as an array of this shape; what is the same for all samples has fewer numbers."""
    if isinstance(element, Residues):
        return np.broadcast_to(element.values, shape)
    return np.full(shape, element % PRIME, dtype=np.uint64)


class Spans:
    """Hold row vectors over the n(n+1)/2 entries of M, in the prime field.

    ``mass`` spans W, ``changes[k]`` spans T_k.
    """

    def __init__(self, arm: Arm, assume: Assume):
        self.n = len(arm.coordinates)
        self.keys = triangle(self.n)
        # a span of dimension d shows in d samples, and the spare ones would have shown a larger one, all but
        # surely
        count = len(self.keys) + TUNING.spare_samples
        mass, potential = field_samples(arm, assume, count)
        self._arm, self._assume, self._count = arm, assume, count
        self.mass = mass[0]
        self.changes = [difference(moved, mass[0]) for moved in mass[1:]]
        self.potential_changes = (potential[1:] != potential[0]).any(axis=1).tolist()

    @cached_property
    def entry_joints(self) -> list[frozenset[int]]:
        """The joints each entry of M depends on."""
        moved = np.array([change.any(axis=0) for change in self.changes])  # (n, entries)
        return [frozenset(np.flatnonzero(column).tolist()) for column in moved.T]

    @cached_property
    def change_bases(self) -> list[np.ndarray]:
        """Echelon bases of T_k, by joint."""
        return list(map(field.row_basis, self.changes))

    @cached_property
    def order(self) -> list[int]:
        """Entries of M, those that depend on much first: in this order they are eliminated."""
        return sorted(range(len(self.keys)), key=lambda index: (-len(self.entry_joints[index]), index))

    @cached_property
    def varying(self) -> np.ndarray:
        """Basis of U, all that changes: an echelon form of columns taken in ``order``."""
        echelon = field.row_basis(np.concatenate(self.change_bases)[:, self.order])
        basis = np.zeros_like(echelon)
        basis[:, self.order] = echelon
        return basis

    @cached_property
    def floats(self) -> np.ndarray:
        """Return twice as many samples of M in double precision, for the sizes of coefficients.

        Their zeros and ranks come from the field.
        """
        return float_samples(self._arm, self._assume, 2 * self._count)

    def float_changes(self, joints: frozenset[int]) -> np.ndarray:
        """Rows that span the changes made by ``joints``, in double precision."""
        base = self.floats[0]
        return np.concatenate([base[:0], *(self.floats[k + 1] - base for k in sorted(joints))])

    def outside(self, joints: frozenset[int]) -> np.ndarray:
        """Rows that span the changes made by joints outside ``joints``, as coordinates in the basis of U."""
        first, last = min(joints), max(joints)
        between = [self._coordinates[k] for k in range(first, last) if k not in joints]
        return np.concatenate([self._nearer_root[first], *between, self._nearer_tip[last]])

    def changes_of(self, coordinates: np.ndarray) -> np.ndarray:
        """Changes of M's entries, (m, entries), by their coordinates (m, dim U) in the basis of U."""
        free = np.ones(len(self.keys), dtype=bool)
        free[self._pivots] = False
        changes = np.zeros((len(coordinates), len(self.keys)), dtype=np.uint64)
        changes[:, self._pivots] = coordinates
        changes[:, free] = field.product(coordinates, self.varying[:, free])
        return changes

    @cached_property
    def _pivots(self) -> list[int]:
        """Entries of M that are the coordinates in the basis of U: its columns there are those of the identity."""
        return [self.order[pivot] for pivot in field.pivots(self.varying[:, self.order])]

    @cached_property
    def _coordinates(self) -> list[np.ndarray]:
        return [basis[:, self._pivots] for basis in self.change_bases]

    @cached_property
    def _nearer_root(self) -> list[np.ndarray]:
        """By joint, a basis of the changes made by the joints before it."""
        bases = [self._coordinates[0][:0]]
        for rows in self._coordinates[:-1]:
            bases.append(field.row_basis(np.concatenate([bases[-1], rows])))
        return bases

    @cached_property
    def _nearer_tip(self) -> list[np.ndarray]:
        """By joint, a basis of the changes made by the joints after it."""
        bases = [self._coordinates[0][:0]]
        for rows in reversed(self._coordinates[1:]):
            bases.insert(0, field.row_basis(np.concatenate([bases[0], rows])))
        return bases
