"""Find the smallest exact form M(q) = sum_k c_k A_k + sum_j f_j(q) B_j, with each f_j on as few joints as possible.

U is the span of all changes of M, W the span of M. A read-out is a weighting of M's entries; on the joints
J only depends exactly that which vanishes on the changes made by every joint outside J. Read-outs are
taken greedily, sets of joints nearest the tip first and small sets before large ones (the independent sets
of a matroid, so no later choice could have done better), single entries of M before sums of them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from itertools import combinations
from math import gcd

import numpy as np

from spelgen.structure import field
from spelgen.structure.sampling import Spans
from spelgen.structure.tuning import TUNING

Weights = tuple[tuple[int, int, Fraction], ...]
"""A sparse symmetric matrix by its lower triangle: (row, column, value), 0-based."""


def row_of(weights: Weights, n: int) -> np.ndarray:
    """Return weights of M's entries, of n joints, as a row (n(n+1)/2,) over its lower triangle."""
    row = np.zeros(n * (n + 1) // 2)
    for i, j, value in weights:
        row[i * (i + 1) // 2 + j] = float(value)
    return row


@dataclass(frozen=True)
class Term:
    """Hold one term of M: a function f(q) of ``joints`` that is left open, or a constant, of no joints.

    It is the sum of ``reads`` x M, and ``basis`` takes it to M.
    """

    joints: tuple[int, ...]
    reads: Weights
    basis: Weights


@dataclass(frozen=True)
class _Reading:
    """Hold a read-out: its exact weights in the field, and the same in double precision."""

    joints: tuple[int, ...]
    weights: np.ndarray
    values: np.ndarray


def smallest_form(spans: Spans) -> tuple[tuple[Term, ...], tuple[Term, ...]]:
    """Return the outputs and constants of the smallest exact form."""
    readings = list(_readings(spans))
    entries = len(spans.keys)
    weights = np.array([r.weights for r in readings], dtype=np.uint64).reshape(-1, entries)
    values = np.array([r.values for r in readings]).reshape(-1, entries)
    # B is fixed by f_j = 1 and all other outputs 0: the inverse of what the read-outs see of U
    basis = field.product(field.inverse(field.product(spans.varying, weights.T)), spans.varying)
    changes = spans.float_changes(frozenset(range(spans.n)))
    basis_values = _solved(changes @ values.T, changes)
    outputs = []
    for r, row, row_values in zip(readings, basis, basis_values, strict=True):
        reads = _weights(spans, r.weights, r.values)
        outputs.append(Term(r.joints, reads, _weights(spans, row, row_values)))
    # what the outputs do not explain cannot vary, so its span is that of the constants
    constant = field.difference(spans.mass, field.product(field.product(spans.mass, weights.T), basis))
    rest_values = spans.floats[0] - spans.floats[0] @ values.T @ basis_values
    return tuple(outputs), _constants(spans, readings, (constant, rest_values), (basis, basis_values))


def _constants(
    spans: Spans,
    readings: list[_Reading],
    constant: tuple[np.ndarray, np.ndarray],
    basis: tuple[np.ndarray, np.ndarray],
) -> tuple[Term, ...]:
    """Return a basis of what the outputs leave of W.

    Entries that are constant themselves are the first choice for a constant.
    """
    # pivots fall on the first columns, so entries that read least become the constants
    order = sorted(range(len(spans.keys)), key=lambda index: (len(spans.entry_joints[index]), -index))
    echelon = field.row_basis(constant[0][:, order])
    bound = [order[pivot] for pivot in field.pivots(echelon)]
    rows = np.zeros_like(echelon)
    rows[:, order] = echelon
    row_values = _solved(constant[1][:, bound], constant[1])
    constants = []
    for pivot, row, values in zip(bound, rows, row_values, strict=True):
        # c is the entry at the pivot less what the outputs put there
        reading, reading_values = _single(spans, pivot)
        for j, output in enumerate(readings):
            coefficient = int(basis[0][j, pivot])
            if coefficient:
                scaled = field.product(np.array([[coefficient]], dtype=np.uint64), output.weights[None])[0]
                reading = field.difference(reading, scaled)
                reading_values = reading_values - basis[1][j, pivot] * output.values
        constants.append(Term((), _weights(spans, reading, reading_values), _weights(spans, row, values)))
    return tuple(constants)


def _readings(spans: Spans) -> Iterator[_Reading]:
    """Yield independent read-outs that together fix every change of M."""
    chosen = np.zeros((0, len(spans.varying)), dtype=np.uint64)
    tried: set[int] = set()
    for joints in _joint_sets(spans):
        outside = field.row_basis(spans.outside(joints))
        kernel = field.null_space(outside)
        # rank of the union less what is chosen: how many outputs this set of joints still adds
        missing = 0
        if len(kernel):
            missing = field.rank(np.concatenate([chosen, kernel])) - len(chosen)
        candidates = _candidates(spans, joints, outside, tried)
        while missing:
            readouts = next(candidates)
            weights = np.array([w for w, _ in readouts], dtype=np.uint64).reshape(-1, len(spans.keys))
            rows = np.concatenate([chosen, field.product(weights, spans.varying.T)])
            # columns of an echelon form have their pivots where they do not depend on those before
            independent = field.pivots(field.row_basis(rows.T))
            for index in independent[len(chosen) :]:
                yield _Reading(tuple(sorted(joints)), *readouts[index - len(chosen)])
            missing -= len(independent) - len(chosen)
            chosen = rows[independent]


def _joint_sets(spans: Spans) -> Iterator[frozenset[int]]:
    """Yield sets of joints that M depends on, nearest the tip first, small before large."""
    active = [k for k in range(spans.n) if len(spans.change_bases[k])]
    for position in reversed(range(len(active))):
        first, later = active[position], active[position + 1 :]
        # small sets first: a matroid lets the greedy choice be the best one
        for size in range(len(later) + 1):
            if spans.n <= TUNING.all_subsets_up_to:
                for tail in combinations(later, size):
                    yield frozenset((first, *tail))
            else:
                yield frozenset((first, *later[:size]))


def _candidates(
    spans: Spans, joints: frozenset[int], outside: np.ndarray, tried: set[int]
) -> Iterator[list[tuple[np.ndarray, np.ndarray]]]:
    """Yield read-outs that depend on ``joints`` only: single entries of M, then the sparsest sums of entries.

    ``outside`` is the basis of the changes made by all other joints, in the basis of U. Entries that were ``tried``
    for fewer joints are chosen or depend on those that are: they are left out, and those of now are put in.
    """
    singles = []
    for index in reversed(range(len(spans.keys))):
        if index not in tried and spans.entry_joints[index] and spans.entry_joints[index] <= joints:
            tried.add(index)
            singles.append(_single(spans, index))
    yield singles
    order = spans.order
    rows = spans.changes_of(outside)[:, order]  # an echelon form, as those of both are
    bound = [order[pivot] for pivot in field.pivots(rows)]
    reduced = field.null_space(rows)
    kernel = np.zeros_like(reduced)
    kernel[:, order] = reduced
    free = np.setdiff1d(np.arange(len(spans.keys)), bound).tolist()
    samples = spans.float_changes(frozenset(range(spans.n)) - joints)
    coefficients = _solved(samples[:, bound], samples[:, free])
    sums = []
    for row in sorted(kernel, key=np.count_nonzero):
        # each row of a null space is 1 at one free entry, and elsewhere nonzero at bound ones only
        (entry,) = set(np.flatnonzero(row).tolist()) - set(bound)
        values = np.zeros(len(row))
        values[entry] = 1.0
        values[bound] = -coefficients[:, free.index(entry)]
        sums.append((row, np.where(row != 0, values, 0.0)))
    yield sums


def _single(spans: Spans, index: int) -> tuple[np.ndarray, np.ndarray]:
    weights = np.zeros(len(spans.keys), dtype=np.uint64)
    weights[index] = 1
    return weights, weights.astype(float)


def _solved(matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Return the least-squares solution X of matrix X = right, both tall."""
    width = matrix.shape[1]
    # the triangular factor holds all there is to know, and is small
    factor = np.asarray(np.linalg.qr(np.concatenate([matrix, right], axis=1), mode="r"))
    result: np.ndarray = np.linalg.lstsq(factor[:, :width], factor[:, width:], rcond=None)[0]
    return result


def _weights(spans: Spans, exact: np.ndarray, values: np.ndarray) -> Weights:
    weights = []
    for index in np.flatnonzero(exact).tolist():
        weights.append((*spans.keys[index], _fraction(int(exact[index]), float(values[index]))))
    return tuple(weights)


def _fraction(element: int, value: float) -> Fraction:
    """Return the rational number behind a field element, near ``value``.

    Rational reconstruction finds it when numerator and denominator are below 2^30 (von zur Gathen and
    Gerhard, *Modern Computer Algebra*, section 5.10). Geometry with irrational sizes gives longer
    fractions; there the double itself is as exact as the URDF.
    """
    bound = 2**30
    previous, current = (field.PRIME, 0), (element, 1)
    while current[0] > bound:
        quotient = previous[0] // current[0]
        previous, current = (
            current,
            (previous[0] - quotient * current[0], previous[1] - quotient * current[1]),
        )
    numerator, denominator = current
    if denominator and gcd(numerator, denominator) == 1:
        candidate = Fraction(numerator, denominator)
        if abs(candidate - Fraction(value)) <= 1e-8 * max(1.0, abs(value)):
            return candidate
    return Fraction(value)
