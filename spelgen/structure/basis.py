"""Minimal exact form M(q) = sum_k c_k A_k + sum_j f_j(q) B_j, in which each f_j depends on a minimal set of joints.

A_k and B_j are constant matrices, c_k constants and f_j functions of q. U is the span of all changes M(q) - M(q'). Each
f_j is a linear functional of M: a weighted sum of the entries of M. A functional depends only on the joints in a set J
if and only if it vanishes on all changes of M caused by joints outside J. Together, the f_j must determine every change
in U.

The f_j are selected greedily from functionals that depend only on a set J of joints, for one set after another. Sets
without joints near the root are first; of the sets with the same joint closest to the root, small sets are first. For
three joints, the order is {3}, {2}, {2, 3}, {1}, {1, 2}, {1, 3}, {1, 2, 3}. For each set, single entries of M are tried
before sums of entries. The sets of functionals that are linearly independent on U form a matroid, for which the greedy
selection is optimal.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from itertools import combinations
from math import gcd
from typing import NamedTuple

import numpy as np

from spelgen.structure import field
from spelgen.structure.sampling import Spans

Weights = tuple[tuple[int, int, Fraction], ...]
"""A sparse symmetric matrix: nonzero elements (row, column, value) of its lower triangle; indices are 0-based."""


def row_of(weights: Weights, n: int) -> np.ndarray:
    """Return the lower triangle of a sparse symmetric (n, n) matrix as a vector (n(n+1)/2,), row after row.

    weights: (row, column, value) of each element of the lower triangle that is not zero.
    """
    row = np.zeros(n * (n + 1) // 2)
    for i, j, value in weights:
        row[i * (i + 1) // 2 + j] = float(value)
    return row


@dataclass(frozen=True)
class Term:
    """A term f(q) B of M: a scalar f times a constant symmetric matrix B.

    Attributes:
        joints: coordinates that the function f depends on; empty if f is a constant.
        functional: coefficients with which f is computed from M: f is the sum over the lower triangle of coefficient
            times entry of M.
        basis: the matrix B.
    """

    joints: tuple[int, ...]
    functional: Weights
    basis: Weights


class _Functional(NamedTuple):
    """A weighted sum of the entries of M that depends on the positions of ``joints`` only.

    Attributes:
        joints: coordinates, in increasing order.
        weights: coefficients of the entries of the lower triangle, (n(n+1)/2,), as elements of the prime field.
        values: the same coefficients in double precision.
    """

    joints: tuple[int, ...]
    weights: np.ndarray
    values: np.ndarray


def smallest_form(spans: Spans) -> tuple[tuple[Term, ...], tuple[Term, ...]]:
    """Return the varying terms f_j(q) B_j and the constant terms c_k A_k whose sum is M, in the minimal exact form.

    Each f_j depends on a minimal set of joints (see the module). spans: samples of M and of its changes with q.
    """
    functionals = list(_functionals(spans))
    entries = len(spans.keys)
    weights = np.array([r.weights for r in functionals], dtype=np.uint64).reshape(-1, entries)
    values = np.array([r.values for r in functionals]).reshape(-1, entries)
    # The rows of R, (m, entries), are the coefficients of the functionals f_j; the rows of U, (m, entries), are a basis
    # of the changes of M. The matrices B_j are the rows of B = (U R^T)^-1 U. Then R B^T is the identity: the functional
    # f_j has the value 1 for B_j, and 0 for each B_i with i other than j.
    basis = field.product(field.inverse(field.product(spans.varying, weights.T)), spans.varying)
    changes = spans.float_changes(frozenset(range(spans.n)))
    basis_values = _solved(changes @ values.T, changes)
    outputs = []
    for r, row, row_values in zip(functionals, basis, basis_values, strict=True):
        functional = _weights(spans, r.weights, r.values)
        outputs.append(Term(r.joints, functional, _weights(spans, row, row_values)))
    # M(q) = sum_k c_k A_k + sum_j f_j(q) B_j. The matrices A_k are a basis of the span of M - sum_j f_j B_j, which does
    # not depend on q. `constant` (prime field), (S, entries), and `constant_values` (double precision), (2 S, entries),
    # are samples of this difference at random positions.
    constant = field.difference(spans.mass, field.product(field.product(spans.mass, weights.T), basis))
    constant_values = spans.floats[0] - spans.floats[0] @ values.T @ basis_values
    # Row reduction of these samples gives the A_k; the entry of M at the pivot of row k defines the constant c_k.
    # Entries that depend on few joints give short formulas for c_k. Such entries are sorted first, since row reduction
    # places pivots in the first possible columns.
    order = sorted(range(entries), key=lambda index: (len(spans.entry_joints[index]), -index))
    echelon = field.row_basis(constant[:, order])
    bound = [order[pivot] for pivot in field.pivots(echelon)]
    rows = np.zeros_like(echelon)
    rows[:, order] = echelon
    solutions = _solved(constant_values[:, bound], constant_values)
    constants = []
    for pivot, row, row_values in zip(bound, rows, solutions, strict=True):
        # At the pivot of row k, A_k has the entry 1 and all other A are zero: c_k is the entry of M at the pivot minus
        # the contribution of the varying terms f_j B_j.
        exact, approximate = _single(spans, pivot)
        for j, output in enumerate(functionals):
            coefficient = int(basis[j, pivot])
            if coefficient:
                scaled = field.product(np.array([[coefficient]], dtype=np.uint64), output.weights[None])[0]
                exact = field.difference(exact, scaled)
                approximate = approximate - basis_values[j, pivot] * output.values
        functional = _weights(spans, exact, approximate)
        constants.append(Term((), functional, _weights(spans, row, row_values)))
    return tuple(outputs), tuple(constants)


def _functionals(spans: Spans) -> Iterator[_Functional]:
    """Yield the functions f_j(q) of the minimal form of M, in the order of the greedy selection (see the module).

    Each f_j is a weighted sum of the entries of M(q). The f_j are independent and determine every change of M with q.
    spans: samples of M and the spans of its changes.
    """
    chosen = np.zeros((0, len(spans.varying)), dtype=np.uint64)
    tried: set[int] = set()
    for joints in _joint_sets(spans):
        outside = spans.outside(joints)
        kernel = field.null_space(outside)[:, np.argsort(spans.order)]
        bound = [spans.order[pivot] for pivot in field.pivots(outside)]
        # `missing`: number of functionals still to be chosen for the set `joints`: functionals that depend on these
        # joints only and are independent of the chosen ones.
        on_changes = field.product(kernel, spans.varying.T)
        missing = field.rank(np.concatenate([chosen, on_changes])) - len(chosen)
        candidates = _candidates(spans, joints, kernel, bound, tried)
        while missing:
            pairs = next(candidates)
            weights = np.array([w for w, _ in pairs], dtype=np.uint64).reshape(-1, len(spans.keys))
            # A functional is a linear function of M: a weighted sum of its entries. A row of `rows` has the values of
            # one functional for the matrices of `spans.varying`, a basis of all changes of M with q. Functionals whose
            # difference does not depend on q have equal rows.
            rows = np.concatenate([chosen, field.product(weights, spans.varying.T)])
            # The pivot columns of the transpose of `rows` are the rows that are linearly independent of earlier rows.
            independent = field.pivots(field.row_basis(rows.T))
            for index in independent[len(chosen) :]:
                yield _Functional(tuple(sorted(joints)), *pairs[index - len(chosen)])
            missing -= len(independent) - len(chosen)
            chosen = rows[independent]


def _joint_sets(spans: Spans) -> Iterator[frozenset[int]]:
    """Yield the sets of joints for which functions f_j(q) of M are searched that depend on this set only, in order.

    M is sum_k c_k A_k + sum_j f_j(q) B_j (see the module). Sets without joints near the root are first; of the sets
    with the same joint closest to the root, small sets are first. For three joints, the order is {3}, {2}, {2, 3}, {1},
    {1, 2}, {1, 3}, {1, 2, 3}. spans: joints without changes of M are in no set.
    """
    # For arms of at most eight joints, all subsets of joints are yielded. Larger arms have too many subsets: their sets
    # consist of consecutive joints.
    all_subsets_up_to = 8
    active = [k for k in range(spans.n) if len(spans.change_bases[k])]
    for position in reversed(range(len(active))):
        first, later = active[position], active[position + 1 :]
        for size in range(len(later) + 1):
            tails = combinations(later, size) if spans.n <= all_subsets_up_to else [later[:size]]
            yield from (frozenset((first, *tail)) for tail in tails)


def _candidates(
    spans: Spans, joints: frozenset[int], kernel: np.ndarray, bound: list[int], tried: set[int]
) -> Iterator[list[tuple[np.ndarray, np.ndarray]]]:
    """Yield two lists of functions of q that depend on ``joints`` only: single entries of M, then sums of entries.

    They are candidates for the functions f_j in the minimal form of M (see the module). Each is a weighted sum of the
    entries of M, given by its weights, (entries,), twice: in the prime field and in double precision.

    A single entry depends on ``joints`` only, or is no candidate. A sum is M_e - sum_b w_b M_b with one entry e outside
    `bound` and the entries b in `bound`. If other joints move, the changes of M_e are a linear combination of the
    changes of the M_b, with the weights w_b: the sum does not change. Sums of few entries are first.

    Args:
        spans: samples of M and the spans of its changes.
        joints: the only joints that the candidates may depend on.
        kernel: weights of the sums in the prime field, (m, entries), one row per entry e outside `bound`.
        bound: indices of as many entries of M as possible whose changes by the other joints are linearly independent.
        tried: indices of entries that were candidates for an earlier set of joints, and are skipped. The single
            entries of this call are added.
    """
    singles = []
    for index in reversed(range(len(spans.keys))):
        if index not in tried and spans.entry_joints[index] and spans.entry_joints[index] <= joints:
            tried.add(index)
            singles.append(_single(spans, index))
    yield singles
    free = np.setdiff1d(np.arange(len(spans.keys)), bound).tolist()
    samples = spans.float_changes(frozenset(range(spans.n)) - joints)
    coefficients = _solved(samples[:, bound], samples[:, free])
    sums = []
    for row in sorted(kernel, key=np.count_nonzero):
        # The weights `row` (prime field) give M_e - sum_b w_b M_b: e = `entry` is the only entry outside `bound`, the
        # entries b are in `bound`. If joints outside `joints` move, M_e and the sum over b change equally, so that
        # their difference is constant. `coefficients` has the weights w_b in double precision.
        (entry,) = set(np.flatnonzero(row).tolist()) - set(bound)
        values = np.zeros(len(row))
        values[entry] = 1.0
        values[bound] = -coefficients[:, free.index(entry)]
        sums.append((row, np.where(row != 0, values, 0.0)))
    yield sums


def _single(spans: Spans, index: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the one-hot weights of the entry ``index`` of M, (entries,): 1 for this entry, 0 for all others.

    The weights are returned twice, like all weights in this module: as elements of the prime field, for exact ranks,
    and as floats, for values of the functions. The row and column of each entry are ``spans.keys``.
    """
    weights = np.zeros(len(spans.keys), dtype=np.uint64)
    weights[index] = 1
    return weights, weights.astype(float)


def _solved(matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Return the least-squares solution X (k, p) of A X = B, with A = matrix (S, k) and B = right (S, p)."""
    width = matrix.shape[1]
    # [A, B] = Q R is replaced by the triangular factor R. The solution is the same, since R^T R = [A, B]^T [A, B]. R
    # has at most k + p rows in place of S.
    factor = np.asarray(np.linalg.qr(np.concatenate([matrix, right], axis=1), mode="r"))
    return np.asarray(np.linalg.lstsq(factor[:, :width], factor[:, width:], rcond=None)[0])


def _weights(spans: Spans, exact: np.ndarray, values: np.ndarray) -> Weights:
    """Return a symmetric matrix as `Weights`: row, column and rational value of each nonzero element.

    The rational value is reconstructed from both given forms of an element (see `_fraction`). exact: elements of the
    lower triangle in the prime field, (entries,). values: the same elements in double precision. spans: `keys` has the
    row and column of each element.
    """
    nonzero = np.flatnonzero(exact).tolist()
    return tuple((*spans.keys[k], _fraction(int(exact[k]), float(values[k]))) for k in nonzero)


def _fraction(element: int, value: float) -> Fraction:
    """Return the fraction n / d with n = d * ``element`` modulo PRIME and the approximate ``value``.

    Such a fraction can be found if n and d are below 2^30 (rational reconstruction: von zur Gathen and Gerhard, *Modern
    Computer Algebra*, section 5.10). Geometry with irrational lengths gives longer fractions: ``value`` is then
    returned, which is as accurate as the URDF.

    element: the number as an element of the prime field. value: the same number in double precision.
    """
    # Rational reconstruction by the extended Euclidean algorithm for (PRIME, element). Each step gives a numerator (the
    # remainder) and a denominator with numerator = denominator * element modulo PRIME. The numerators decrease and the
    # denominators grow, so the first numerator of at most 2^30 has the smallest denominator.
    previous, current = (field.PRIME, 0), (element, 1)
    while current[0] > 2**30:
        quotient = previous[0] // current[0]
        remainder = previous[0] - quotient * current[0], previous[1] - quotient * current[1]
        previous, current = current, remainder
    numerator, denominator = current
    if denominator and gcd(numerator, denominator) == 1:
        candidate = Fraction(numerator, denominator)
        # For any element, the algorithm finds a fraction that equals the element modulo PRIME. The fraction is the
        # represented number only if it is also close to `value`; otherwise the number has no short fraction.
        if abs(candidate - Fraction(value)) <= 1e-8 * max(1.0, abs(value)):
            return candidate
    return Fraction(value)
