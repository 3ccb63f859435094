"""CasADi symbols that represent the residual terms of a model.

The scalar expressions of a model contain the residual terms as symbols, so that exported code can compute these terms
by loops over network weights and lookup of splines. R is the part of M that a network computes, with m nonzero entries
in the lower triangle; k is the number of joints whose friction depends on q. The symbols are:

- ``mass`` (m, 1), entries of R; ``rate`` (m, 1), d mass / dt; ``kinetic`` (n, 1), d/dq of 1/2 qd^T R qd;
- ``energy`` (1, 1), the network of the potential energy V; ``gravity`` (n, 1), d energy / dq;
- ``torque`` (n, 1), torques that depend on the position of a single joint; ``torque_energy`` (1, 1), their energy;
- ``factor`` (k, 1), logarithms of the friction factors.
"""

import casadi as ca

from spelgen.exporting.description import TrainedModel

Symbols = dict[str, ca.SX]


def residual_symbols(model: TrainedModel) -> Symbols:
    """Return {name: CasADi symbol} of all residual terms of a model; absent terms are structural zeros."""
    n = model.n
    residuals = model.residuals
    entries, factors = len(residuals.entries), len(residuals.friction)
    has_potential = residuals.potential is not None
    # {name: (whether the model has this term, number of rows)}
    sizes = {
        "mass": (entries, entries),
        # `rate` and `kinetic` are directional derivatives of the network. Each is computed in one pass through the
        # network; the Jacobian of `mass` would take n passes.
        "rate": (entries, entries),
        "kinetic": (entries, n),
        "energy": (has_potential, 1),
        "gravity": (has_potential, n),
        "torque": (residuals.has_torque, n),
        "torque_energy": (residuals.has_torque, 1),
        "factor": (factors, factors),
    }
    symbols = {}
    for name, (exists, rows) in sizes.items():
        symbols[name] = ca.SX.sym(name, rows) if exists else ca.SX(rows, 1)
    return symbols


def symmetric(model: TrainedModel, values: ca.SX) -> ca.SX:
    """Return the symmetric matrix (n, n) with the structure of R, the residual term of M.

    values: (m, 1), for the m nonzero entries in the lower triangle of R.
    """
    matrix = ca.SX(model.n, model.n)
    for k, (row, column) in enumerate(model.residuals.entries):
        matrix[row, column] = matrix[column, row] = values[k]
    return matrix
