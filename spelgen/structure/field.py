"""Batches of elements of the prime field GF(2^61 - 1), and linear algebra over this field.

The structure of an arm is derived from ranks and zeros of M(q) at random points of the field. A nonzero polynomial
vanishes at a random point with probability at most degree / 2^61 (Schwartz 1980, Zippel 1979), and a rank over the
field never exceeds the rank over the rationals. A rank or a zero at random points is therefore exact with an error
probability of about 1e-16, without tolerances and without explicit polynomials.

Arrays of field elements have the dtype uint64.
"""

from __future__ import annotations

from fractions import Fraction

import numpy as np
from flint import fmpz_mat, nmod_mat

# PRIME is a Mersenne prime: 2^61 = 1 modulo PRIME. The remainder of a number needs no division: the bits from bit 61 on
# are added to the low 61 bits.
PRIME = 2**61 - 1
_P = np.uint64(PRIME)
# These shifts and masks split a field element into its low 31 bits and its high 30 bits: products of such numbers fit
# into 64 bits.
_BITS_61, _BITS_31, _BITS_30 = map(np.uint64, (61, 31, 30))
_LOW_31, _LOW_30 = _P >> _BITS_30, _P >> _BITS_31


class Residues:
    """A batch of field elements, (...,), with elementwise +, - and * with other batches and with integers."""

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
        return self + -operand

    def __rsub__(self, operand: int) -> Residues:
        return -self + operand

    def __mul__(self, operand: Residues | int) -> Residues | int:
        if isinstance(operand, int) and operand in (0, 1):
            return self if operand else 0
        return Residues(_product(self.values, _values(operand)))

    __rmul__ = __mul__


def residue(number: Fraction) -> int:
    """Return the element of the prime field that represents a rational number: numerator / denominator modulo PRIME."""
    return number.numerator * pow(number.denominator, -1, PRIME) % PRIME


def random_residues(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """Return an array of independent, uniformly distributed field elements."""
    return rng.integers(0, PRIME, shape, dtype=np.uint64)


def random_circle_points(rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return random elements c, s of the prime field, (count,) each, with c^2 + s^2 = 1, as cosines and sines."""
    cosines, sines = [], []
    for t in random_residues(rng, (count,)).tolist():
        # t is the tangent of half the angle. 1 + t^2 is never 0: -1 has no square root modulo a prime of the form
        # 4k + 3, such as PRIME.
        inverse = pow(1 + t * t, -1, PRIME)
        cosines.append((1 - t * t) * inverse % PRIME)
        sines.append(2 * t * inverse % PRIME)
    return np.array(cosines, dtype=np.uint64), np.array(sines, dtype=np.uint64)


def difference(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return a - b modulo the prime, elementwise; a and b are field elements of the same shape (...,)."""
    return _folded(a + (_P - b))


def row_basis(rows: np.ndarray) -> np.ndarray:
    """Return the reduced row echelon form of ``rows``, (m, n), without zero rows: (rank, n)."""
    # FLINT raises errors for matrices without rows or columns: their row space is empty.
    if not rows.size:
        return rows[:0]
    reduced, rank = _matrix(rows).rref()
    return _array(reduced, rank)


def rank(rows: np.ndarray) -> int:
    """Return the rank of the matrix ``rows``, (m, n), over the prime field."""
    return int(_matrix(rows).rank()) if rows.size else 0


def pivots(basis: np.ndarray) -> list[int]:
    """Return the pivots of an echelon form, (m, n): the index of the first nonzero element of each row."""
    return (basis != 0).argmax(axis=1).tolist() if basis.size else []


def null_space(basis: np.ndarray) -> np.ndarray:
    """Return a basis of the null space {x : basis x = 0}, (n - rank, n).

    basis: a result of ``row_basis``, (rank, n). Each row of the null space's basis is 1 at one column without a pivot;
    all other nonzero elements are at pivots.
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
    """Return the matrix product a b, (m, n), over the prime field; a: (m, k), b: (k, n)."""
    if not a.size or not b.size:
        return np.zeros((a.shape[0], b.shape[1]), dtype=np.uint64)
    return _array(_matrix(a) * _matrix(b))


def inverse(square: np.ndarray) -> np.ndarray:
    """Return the inverse of a nonsingular matrix, (n, n), over the prime field."""
    return _array(_matrix(square).inv()) if square.size else square


def _matrix(rows: np.ndarray) -> nmod_mat:
    """Return an array of field elements, (m, n), as a matrix of FLINT."""
    # A conversion through FLINT's integer matrix is faster than a conversion element by element.
    return nmod_mat(fmpz_mat(rows.shape[0], rows.shape[1], rows.ravel().tolist()), PRIME)


def _array(matrix: nmod_mat, rows: int | None = None) -> np.ndarray:
    """Return the first ``rows`` rows of a matrix of FLINT as an array, (rows, n); None: all rows."""
    height, width = matrix.nrows() if rows is None else rows, matrix.ncols()
    entries = map(int, matrix.entries()[: height * width])
    return np.fromiter(entries, dtype=np.uint64, count=height * width).reshape(height, width)


def _values(operand: Residues | int) -> np.ndarray | np.uint64:
    """Return an operand of `Residues` as field elements: an array (...,), or a scalar for an integer."""
    return operand.values if isinstance(operand, Residues) else np.uint64(operand % PRIME)


def _folded(values: np.ndarray) -> np.ndarray:
    """Return numbers below 2^62, (...,), modulo the prime 2^61 - 1."""
    return np.where(values >= _P, values - _P, values)


def _product(a: np.ndarray, b: np.ndarray | np.uint64) -> np.ndarray:
    """Return the elementwise product a b modulo 2^61 - 1, (...,), in 64-bit arithmetic.

    With a = a1 2^31 + a0 and b = b1 2^31 + b0: a b = a1 b1 2^62 + (a1 b0 + a0 b1) 2^31 + a0 b0.
    Modulo 2^61 - 1, 2^61 is 1, so that the powers of 2 in the sum are reduced without a division.
    """
    a_high, a_low, b_high, b_low = a >> _BITS_31, a & _LOW_31, b >> _BITS_31, b & _LOW_31
    middle = a_high * b_low + a_low * b_high
    total = (
        (a_high * b_high << np.uint64(1))
        + (middle >> _BITS_30)
        + ((middle & _LOW_30) << _BITS_31)
        + a_low * b_low
    )
    return _folded((total & _P) + (total >> _BITS_61))
