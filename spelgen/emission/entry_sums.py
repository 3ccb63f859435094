"""The entries of M as linear combinations of its functions and constants."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence

import numpy as np

from spelgen.spec import ConstantSpec, ModelSpec, OutputSpec

Sums = list[tuple[float, int]]
"""Factors and indices of the terms of an entry: functions first, then constants; positive factors first."""


def entry_sums(spec: ModelSpec) -> list[list[Sums]]:
    """Return the terms of each entry of the lower triangle of M, row after row."""
    cells: defaultdict[tuple[int, int], Sums] = defaultdict(list)
    terms: Sequence[OutputSpec | ConstantSpec] = (*spec.outputs, *spec.constants)
    for index, term in enumerate(terms):
        for row, column, factor in term.basis:
            cells[row, column].append((factor, index))
    ordered = {entry: sorted(sums, key=lambda term: term[0] < 0) for entry, sums in cells.items()}
    return [[ordered.get((row, column), []) for column in range(row + 1)] for row in range(len(spec.joints))]


def term_names(spec: ModelSpec) -> list[str]:
    """Return the names of the terms: f1, f2, ... of functions and c1, c2, ... of constants."""
    return [f"f{k + 1}" for k in range(len(spec.outputs))] + [f"c{k + 1}" for k in range(len(spec.constants))]


def mean_mass(n: int, outputs: Sequence[OutputSpec], constants: Sequence[ConstantSpec]) -> np.ndarray:
    """Return the lower triangle of the nominal mean of M without armature, (n, n), to six digits."""
    mean = np.zeros((n, n))
    for constant in constants:
        for row, column, value in constant.basis:
            mean[row, column] += constant.start * value
    for output in outputs:
        for row, column, value in output.basis:
            mean[row, column] += output.mean * value
    return np.array([[float(f"{value:.6g}") for value in row] for row in mean])
