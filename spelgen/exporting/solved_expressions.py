"""The solution of a positive definite system as CasADi expressions."""

from __future__ import annotations

import casadi as ca


def solved(matrix: ca.SX, right: ca.SX) -> ca.SX:
    """matrix^-1 right of a symmetric positive definite matrix, by L D L^T; right: (n, columns)."""
    n = matrix.shape[0]
    lower, inverses = _factor(matrix)
    rows = [right[i, :] for i in range(n)]
    for i in range(n):
        for k in range(i):
            rows[i] = rows[i] - lower[i][k] * rows[k]
    rows = [row * scale for row, scale in zip(rows, inverses, strict=True)]
    for i in reversed(range(n)):
        for k in range(i + 1, n):
            rows[i] = rows[i] - lower[k][i] * rows[k]
    return ca.vertcat(*rows)


def _factor(matrix: ca.SX) -> tuple[list[list[ca.SX]], list[ca.SX]]:
    """L, unit lower triangular, and D^-1 of L D L^T."""
    n = matrix.shape[0]
    lower = [[ca.SX(0)] * n for _ in range(n)]
    pivots: list[ca.SX] = []
    inverses: list[ca.SX] = []
    for j in range(n):
        scaled = [lower[j][k] * pivots[k] for k in range(j)]
        pivots.append(matrix[j, j] - sum((lower[j][k] * scaled[k] for k in range(j)), ca.SX(0)))
        inverses.append(1 / pivots[j])
        for i in range(j + 1, n):
            rest = sum((lower[i][k] * scaled[k] for k in range(j)), ca.SX(0))
            lower[i][j] = (matrix[i, j] - rest) * inverses[j]
    return lower, inverses
