"""Samples of M and V at random positions, and linear spans of them, from which the structure of an arm is derived.

M is the mass matrix, V the potential energy. The spans are spans of samples of M, and of differences of two samples
between which one coordinate changes. Samples are elements of the prime field of ``field``, or floating-point numbers.
They form 1 + n blocks of equal size for n coordinates. Block 0 has random positions; the positions of block 1 + k
differ from block 0 in coordinate k only (k from 0). An entry of M that differs between block 0 and block 1 + k depends
on coordinate k.
"""

from collections.abc import Sequence
from fractions import Fraction

import numpy as np

from spelgen.arm.arm import Chain
from spelgen.structure import field
from spelgen.structure.field import PRIME, Residues, difference, random_residues, residue
from spelgen.structure.recursion import Element, Position, base_denominators, coefficients, energies, triangle
from spelgen.urdf.robot import Assume

Ten = Sequence[Element]


def field_samples(arm: Chain, assume: Assume, samples: int) -> tuple[np.ndarray, np.ndarray]:
    """Return lower triangles of M, (1 + n, samples, n(n+1)/2), and V, (1 + n, samples), in the prime field.

    M is the mass matrix, V the potential energy. The first axis has 1 + n blocks: block 0 has random positions; the
    positions of block 1 + k differ from block 0 in coordinate k only.

    Args:
        arm: the arm, with n coordinates.
        assume: ``kinematics``: each sample has other random inertial parameters. ``inertials``: all samples have the
            inertial parameters of the URDF.
        samples: number of samples per block.
    """
    rng = np.random.default_rng(0)
    n = len(arm.coordinates)
    positions = []
    for index in range(n):
        # A `Position` has a cosine and a sine, for revolute joints, and a value of q, for prismatic joints. The value
        # is an independent random number: in a prime field there is no angle that belongs to a cosine and a sine.
        c, s = field.random_circle_points(rng, 2 * samples)
        value = random_residues(rng, (2 * samples,))
        moved = [Residues(_one_moved(x, index, 1 + n)) for x in (c, s, value)]
        positions.append(Position(*moved))
    if assume == "kinematics":
        # With random inertial parameters, ranks and zeros of the samples are valid for all values of the parameters,
        # except for special values (of probability 0).
        inertias: list[Ten] = [list(map(Residues, random_residues(rng, (10, samples)))) for _ in arm.bodies]
    else:
        inertias = [list(map(residue, body.inertia or (Fraction(0),) * 10)) for body in arm.bodies]
    # The recursion computes with arrays in place of numbers, so that one pass computes all samples.
    result = energies(arm, positions, inertias, residue)
    shape = (1 + n, samples)
    entries = [_residue_values(entry, shape) for entry in result.mass.values()]
    return np.stack(entries, axis=-1), _residue_values(result.potential, shape)


def regressor_rows(arm: Chain, points: int) -> np.ndarray:
    """Return the energy regressor at random positions, (m points, 10 B) for B bodies, in the prime field.

    The elements are integers modulo 2^61 - 1, so that ranks need no tolerances. There are m = n(n+1)/2 + 1 rows per
    position: the coefficients of the inertial parameters in the entries of M(q) and in V(q) - V(q0), with q0 the first
    position. M and V are linear in the inertial parameters and determine the torque: the rank of the rows is the number
    of base parameters (Gautier and Khalil 1990).

    points: number of random positions.
    """
    rng = np.random.default_rng(1)
    parameters = 10 * len(arm.bodies)
    positions = []
    for _ in arm.coordinates:
        c, s = field.random_circle_points(rng, points)
        value = random_residues(rng, (points,))
        columns = [Residues(x[:, None]) for x in (c, s, value)]
        positions.append(Position(*columns))
    units = list(map(Residues, np.eye(parameters, dtype=np.uint64)))
    elements = coefficients(arm, positions, units, residue)
    rows = np.stack([_residue_values(element, (points, parameters)) for element in elements], axis=1)
    # V is determined up to a constant: its row at the first position is subtracted from all its rows.
    rows[:, -1] = difference(rows[:, -1], rows[0, -1])
    return rows.reshape(-1, parameters)


def float_samples(arm: Chain, assume: Assume, samples: int, seed: int = 2) -> np.ndarray:
    """Return lower triangles of M at random positions in double precision, (1 + n, samples, n(n+1)/2).

    Index 0 of the first axis has random positions. The positions at index 1 + k differ from them in coordinate k only.
    assume: ``kinematics``: each of the samples has other random inertial parameters; ``inertials``: all samples have
    the inertial parameters of the URDF. samples: samples per index. seed: seed of positions and inertial parameters.
    """
    rng = np.random.default_rng(seed)
    n = len(arm.coordinates)
    q = [_one_moved(rng.uniform(-3.0, 3.0, 2 * samples), index, 1 + n) for index in range(n)]
    inertias = [list(rng.normal(size=(10, samples))) for _ in arm.bodies]
    if assume == "inertials":
        inertias = [list(map(float, body.inertia or (0,) * 10)) for body in arm.bodies]
    mass, _ = float_energies(arm, np.stack(q, axis=-1), inertias)
    return mass


def float_energies(arm: Chain, q: np.ndarray, inertias: Sequence[Ten]) -> tuple[np.ndarray, np.ndarray]:
    """Return the lower triangle of the mass matrix M, and the potential energy V, at positions q in double precision.

    Args:
        arm: the arm, with n coordinates.
        q: positions, (..., n) [rad, m], real, or complex for complex-step derivatives.
        inertias: ten inertial parameters per body; each is a number, or an array (...,) with a value per position.

    Returns:
        Lower triangles of M, row after row, (..., n(n+1)/2) [kg m^2, kg m, kg], and V, (...,) [J].
    """
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
    """Return the values of coordinate ``index`` in all blocks of S samples, (blocks, S).

    Samples consist of blocks (see the module). In block ``index`` + 1 only this coordinate differs from block 0: this
    block gets the last S of the random ``values``, (2 S,), and all other blocks get the first S values.
    """
    base, moved = np.split(values, 2)
    result = np.tile(base, (blocks, 1))
    result[index + 1] = moved
    return result


def _residue_values(element: Residues | int, shape: tuple[int, ...]) -> np.ndarray:
    """Return a batch of field elements, or an integer, as an array of field elements, broadcast to ``shape``."""
    if isinstance(element, Residues):
        return np.broadcast_to(element.values, shape)
    return np.full(shape, element % PRIME, dtype=np.uint64)


class Spans:
    """Linear spans of M and of its changes, from which the structure of an arm is derived.

    M is the mass matrix, V the potential energy. The spans are computed in the prime field (integers modulo 2^61 - 1),
    in which ranks and zeros need no tolerances. A vector of the spans has the n(n+1)/2 entries of the lower triangle of
    M. W is the span of all M(q), T_i the span of the changes of M if only coordinate i moves, and U the sum of all T_i.
    A basis has a row per dimension.

    Attributes:
        n: Number of coordinates.
        keys: (row, column) of each entry.
        mass: S samples of M that span W, (S, entries).
        potential_changes: Whether V depends on each coordinate.
        entry_joints: Set of the joints on which an entry of M depends, for each entry.
        order: Order in which entries of M are eliminated: entries that depend on many joints first.
        change_bases: Echelon basis of each T_i, (dim T_i, entries), with the entries in the order ``order``.
        varying: Basis of U, (dim U, entries).
        floats: Samples of M in double precision, (1 + n, 2 S, entries): in block 1 + k, only coordinate k differs from
            block 0. The structure has functions that are weighted sums of entries of M (see `structure.basis`). The
            prime field determines the entries with nonzero weights; a least-squares fit to these samples determines the
            weights as floats. 2 S samples give the fit a better condition than S.
    """

    def __init__(self, arm: Chain, assume: Assume):
        self.n = len(arm.coordinates)
        self.keys = triangle(self.n)
        # A span has at most as many dimensions as M has entries; with four more samples than entries, a rank that is
        # too small by chance is less likely.
        count = len(self.keys) + 4
        mass, potential = field_samples(arm, assume, count)
        self.mass = mass[0]
        self.potential_changes = (potential[1:] != potential[0]).any(axis=1).tolist()
        changes = [difference(block, mass[0]) for block in mass[1:]]
        # `depends`, (n, entries): True if an entry of M varies with a coordinate.
        depends = np.array([change.any(axis=0) for change in changes])
        self.entry_joints = [frozenset(np.flatnonzero(column).tolist()) for column in depends.T]
        self.order = sorted(range(len(self.keys)), key=lambda index: (-len(self.entry_joints[index]), index))
        self.change_bases = [field.row_basis(change[:, self.order]) for change in changes]
        self.varying = field.row_basis(np.concatenate(self.change_bases))[:, np.argsort(self.order)]
        self.floats = float_samples(arm, assume, 2 * count)

    def float_changes(self, joints: frozenset[int]) -> np.ndarray:
        """Return changes of M if one of ``joints`` moves, in double precision, (2 S joints, entries).

        The rows are ordered by increasing joint; each joint has 2 S rows. A row is a difference of two samples of
        ``floats``: M with another position of this joint (block 1 + joint) minus M at the same positions of all other
        joints (block 0). A block has 2 S samples.
        """
        base = self.floats[0]
        return np.concatenate([base[:0], *(self.floats[k + 1] - base for k in sorted(joints))])

    def outside(self, joints: frozenset[int]) -> np.ndarray:
        """Return an echelon basis of the changes of M if joints other than ``joints`` move, (dimension, entries).

        T_i is the span of all changes M(q) - M(q') if only joint i moves. The result is a basis, in the prime field, of
        the sum of T_i over all joints i that are not in ``joints``. The columns are the entries of M in the order of
        the attribute ``order``.
        """
        others = [basis for k, basis in enumerate(self.change_bases) if k not in joints]
        return field.row_basis(np.concatenate([self.varying[:0], *others]))
