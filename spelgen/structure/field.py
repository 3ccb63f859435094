"""Batches of numbers in the prime field of 2^61 - 1, and linear algebra over it.

A polynomial that is not zero vanishes at a random point of this field with probability at most degree /
2^61 (Schwartz 1980, Zippel 1979), and a rank found here is never above the rank over the rationals. So
what holds here at random points holds exactly, but for odds of about 1e-16 a question, without a tolerance
and without writing a polynomial down.
"""

from __future__ import annotations

from fractions import Fraction

import numpy as np
from flint import fmpz_mat, nmod_mat

_EXPONENT = 61  # of a Mersenne prime: remainders are sums of shifted bits


def _ones(count: int) -> int:
    """Return the integer of so many binary ones."""
    return (1 << count) - 1


PRIME = _ones(_EXPONENT)
_P = np.uint64(PRIME)
_LOWER = _EXPONENT // 2
_UPPER = _EXPONENT - _LOWER  # bits of the halves whose products fit into 64 bits
_BITS_61, _BITS_31, _BITS_30 = np.uint64(_EXPONENT), np.uint64(_UPPER), np.uint64(_LOWER)
_LOW_31, _LOW_30 = np.uint64(_ones(_UPPER)), np.uint64(_ones(_LOWER))


class Residues:
    """A batch of field elements with elementwise +, - and *, among themselves and with integers."""

    __slots__ = ("values",)

    def __init__(self, values: np.ndarray):
        self.values = values

    def __add__(self, operand: Residues | int) -> Residues:
        if isinstance(operand, int) and operand == 0:
            return self
        return Residues(_folded(self.values + _values(operand)))

    __radd__ = __add__

    def __neg__(self) -> Residues:
        return Residues(_folded(_P - self.values))

    def __sub__(self, operand: Residues | int) -> Residues:
        if isinstance(operand, int) and operand == 0:
            return self
        return Residues(_folded(self.values + (_P - _values(operand))))

    def __rsub__(self, operand: int) -> Residues:
        return -self + operand

    def __mul__(self, operand: Residues | int) -> Residues | int:
        if isinstance(operand, int):
            if operand in (0, 1):
                return self if operand else 0
            if operand == 2:
                return Residues(_folded(self.values + self.values))
        return Residues(_product(self.values, _values(operand)))

    __rmul__ = __mul__


def residue(number: Fraction) -> int:
    """The field element of a rational number."""
    return number.numerator * pow(number.denominator, -1, PRIME) % PRIME


def random_residues(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """Uniform field elements."""
    return rng.integers(0, PRIME, shape, dtype=np.uint64)


def random_circle_points(rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
    """``count`` random solutions (c, s) of c^2 + s^2 = 1, by the rational half-angle parameter."""
    cosines, sines = [], []
    for t in random_residues(rng, (count,)).tolist():
        # 1 + t^2 is never 0: -1 has no square root modulo a prime of the form 4k + 3
        inverse = pow(1 + t * t, -1, PRIME)
        cosines.append((1 - t * t) * inverse % PRIME)
        sines.append(2 * t * inverse % PRIME)
    return np.array(cosines, dtype=np.uint64), np.array(sines, dtype=np.uint64)


def difference(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """a - b in the field, elementwise."""
    return _folded(a + (_P - b))


def row_basis(rows: np.ndarray) -> np.ndarray:
    """The reduced row echelon form of (m, n) ``rows`` without its zero rows, (rank, n)."""
    # FLINT refuses matrices without rows or columns
    if not rows.size:
        return rows[:0]
    reduced, rank = _matrix(rows).rref()
    return _array(reduced, rank)


def rank(rows: np.ndarray) -> int:
    """Rank of the (m, n) matrix ``rows``."""
    return int(_matrix(rows).rank()) if rows.size else 0


def pivots(basis: np.ndarray) -> list[int]:
    """First nonzero column of each row of an echelon form."""
    return (basis != 0).argmax(axis=1).tolist() if basis.size else []


def null_space(basis: np.ndarray) -> np.ndarray:
    """Return rows that span {x : basis x = 0} of a ``row_basis``.

    Each is 1 at one free column and elsewhere nonzero at pivots only.
    """
    width = basis.shape[1]
    bound = pivots(basis)
    free = np.setdiff1d(np.arange(width), bound)
    kernel = np.zeros((len(free), width), dtype=np.uint64)
    for row, column in enumerate(free):
        kernel[row, column] = 1
        kernel[row, bound] = (_P - basis[:, column]) % _P
    return kernel


def product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The matrix product of (m, k) and (k, n) in the field."""
    if not a.size or not b.size:
        return np.zeros((a.shape[0], b.shape[1]), dtype=np.uint64)
    return _array(_matrix(a) * _matrix(b))


def inverse(square: np.ndarray) -> np.ndarray:
    """The inverse of a regular matrix in the field."""
    return _array(_matrix(square).inv()) if square.size else square


def _matrix(rows: np.ndarray) -> nmod_mat:
    # faster than to make a residue of every number by itself
    return nmod_mat(fmpz_mat(rows.shape[0], rows.shape[1], rows.ravel().tolist()), PRIME)


def _array(matrix: nmod_mat, rows: int | None = None) -> np.ndarray:
    """The first ``rows`` of ``matrix``, all of them by default."""
    height, width = matrix.nrows() if rows is None else rows, matrix.ncols()
    entries = map(int, matrix.entries()[: height * width])
    return np.fromiter(entries, dtype=np.uint64, count=height * width).reshape(height, width)


def _values(operand: Residues | int) -> np.ndarray | np.uint64:
    return operand.values if isinstance(operand, Residues) else np.uint64(operand % PRIME)


def _folded(values: np.ndarray) -> np.ndarray:
    """Numbers below 2^62 brought below the prime."""
    return np.where(values >= _P, values - _P, values)


def _product(a: np.ndarray, b: np.ndarray | np.uint64) -> np.ndarray:
    """Products modulo 2^61 - 1 in 64-bit arithmetic: halves of 30 and 31 bits, and 2^61 = 1."""
    a_high, a_low, b_high, b_low = a >> _BITS_31, a & _LOW_31, b >> _BITS_31, b & _LOW_31
    middle = a_high * b_low + a_low * b_high
    total = (
        (a_high * b_high << np.uint64(1))
        + (middle >> _BITS_30)
        + ((middle & _LOW_30) << _BITS_31)
        + a_low * b_low
    )
    return _folded((total & _P) + (total >> _BITS_61))
