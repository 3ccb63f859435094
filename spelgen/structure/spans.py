"""Find the spans that decide an arm's structure: of its mass matrix, and of the changes each joint makes to it."""

from __future__ import annotations

from functools import cached_property

import numpy as np

from spelgen.arm.arm import Arm
from spelgen.settings.tuning.structure import StructureTuning
from spelgen.spec import Assume
from spelgen.structure import field
from spelgen.structure.recursion import triangle
from spelgen.structure.sampling import Samples, field_samples, float_samples

TUNING = StructureTuning()


class Spans:
    """Hold row vectors over the n(n+1)/2 entries of M, in the prime field: ``mass`` spans W, ``changes[k]`` spans
    T_k.
    """

    def __init__(self, arm: Arm, assume: Assume):
        self.n = len(arm.coordinates)
        self.keys = triangle(self.n)
        # a span of dimension d shows in d samples, and the spare ones would have shown a larger one, all but
        # surely
        count = len(self.keys) + TUNING.spare_samples
        samples = field_samples(arm, assume, count)
        self._arm, self._assume, self._count = arm, assume, count
        self.mass = samples.mass[0]
        self.changes = [field.difference(moved, samples.mass[0]) for moved in samples.mass[1:]]
        self.potential_changes = (samples.potential[1:] != samples.potential[0]).any(axis=1).tolist()

    @cached_property
    def entry_joints(self) -> list[frozenset[int]]:
        """The joints each entry of M depends on."""
        moved = np.array([change.any(axis=0) for change in self.changes])  # (n, entries)
        return [frozenset(np.flatnonzero(column).tolist()) for column in moved.T]

    @cached_property
    def change_bases(self) -> list[np.ndarray]:
        """Echelon bases of T_k, by joint."""
        return [field.row_basis(change) for change in self.changes]

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
    def floats(self) -> Samples:
        """Twice as many samples in double precision, for the sizes of coefficients; their zeros and ranks
        come from the field.
        """
        return float_samples(self._arm, self._assume, 2 * self._count)

    @property
    def float_mass(self) -> np.ndarray:
        """Rows that span W in double precision."""
        result: np.ndarray = self.floats.mass[0]
        return result

    def float_changes(self, joints: frozenset[int]) -> np.ndarray:
        """Rows that span the changes made by ``joints``, in double precision."""
        base = self.floats.mass[0]
        return np.concatenate([self.floats.mass[k + 1] - base for k in sorted(joints)] or [base[:0]])

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
