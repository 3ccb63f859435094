"""CasADi symbols that represent the residual terms of a model.

The scalar expressions of a model contain the residual terms as symbols, so that exported code can compute these terms
by loops over network weights and lookup of splines. R is the part of M that a network computes, with m nonzero entries
in the lower triangle; k is the number of joints whose friction depends on q. The symbols are:

- ``mass`` (m, 1), entries of R; ``rate`` (m, 1), d mass / dt; ``kinetic`` (n, 1), d/dq of 1/2 qd^T R qd;
- ``energy`` (1, 1), the network of the potential energy V; ``gravity`` (n, 1), d energy / dq;
- ``torque`` (n, 1), torques that depend on the position of a single joint; ``torque_energy`` (1, 1), their energy;
- ``factor`` (k, 1), logarithms of the friction factors.

Derivatives of the dynamics depend on further symbols: ``first`` (m, n) and ``second`` (m, n n), the first and second
derivatives of mass with respect to q (second has n columns per joint), which replace rate and kinetic; ``stiffness``
(n, n), d gravity / dq; ``torque_slope`` (n, 1) and ``factor_slope`` (k, 1), derivatives with respect to the joint's own
position.
"""

from typing import TypeVar

import casadi as ca
import numpy as np

from spelgen.exporting.description import TrainedModel

Symbols = dict[str, ca.SX]
Scalars = TypeVar("Scalars", ca.SX, ca.MX)


def residual_symbols(model: TrainedModel) -> Symbols:
    """Return {name: CasADi symbol} of all residual terms of a model; absent terms are structural zeros."""
    n = model.n
    residuals = model.residuals
    entries, factors = len(residuals.entries), len(residuals.friction)
    has_potential = residuals.potential is not None
    sizes = {
        "mass": (entries, entries, 1),
        # `rate` and `kinetic` are directional derivatives of the network. Each is computed in one pass through the
        # network; the Jacobian `first` would take n passes.
        "rate": (entries, entries, 1),
        "kinetic": (entries, n, 1),
        # `first`, `second`, `torque_slope` and `factor_slope` occur only in derivatives of the dynamics.
        "first": (entries, entries, n),
        "second": (entries, entries, n * n),
        "energy": (has_potential, 1, 1),
        "gravity": (has_potential, n, 1),
        "stiffness": (has_potential, n, n),
        "torque": (residuals.has_torque, n, 1),
        "torque_slope": (residuals.has_torque, n, 1),
        "torque_energy": (residuals.has_torque, 1, 1),
        "factor": (factors, factors, 1),
        "factor_slope": (factors, factors, 1),
    }
    symbols = {}
    for name, (exists, *size) in sizes.items():
        symbols[name] = ca.SX.sym(name, *size) if exists else ca.SX(*size)
    return symbols


def symmetric(model: TrainedModel, values: ca.SX) -> ca.SX:
    """Return the symmetric matrix (n, n) with the structure of R, the residual term of M.

    values: (m, 1), for the m nonzero entries in the lower triangle of R.
    """
    matrix = ca.SX(model.n, model.n)
    for k, (row, column) in enumerate(model.residuals.entries):
        matrix[row, column] = matrix[column, row] = values[k]
    return matrix


def coriolis(model: TrainedModel, symbols: Symbols, qd: ca.SX, *, derivatives: bool) -> ca.SX:
    """Return the Coriolis torque of R, the residual term of M: dR/dt qd - d/dq (1/2 qd^T R qd), (n, 1).

    symbols: result of `residual_symbols`. Its ``mass`` has the entries of R, ``rate`` is d mass / dt, ``kinetic`` is
    d/dq of 1/2 qd^T R qd, and ``first`` is the Jacobian of ``mass`` with respect to q. derivatives: True if the result
    will be differentiated with respect to q. The result then depends on ``first``, and not on ``rate`` and ``kinetic``,
    whose Jacobians have no symbols.
    """
    if not derivatives:
        return symmetric(model, symbols["rate"]) @ qd - symbols["kinetic"]
    kinetic = symbols["first"].T @ in_kinetic_energy(model, qd)
    return symmetric(model, symbols["first"] @ qd) @ qd - kinetic


def in_kinetic_energy(model: TrainedModel, qd: Scalars) -> Scalars:
    """Return the coefficients c, (m, 1), with which the residual term R of M gives 1/2 qd^T R qd = c^T r.

    r, (m, 1): the m nonzero entries in the lower triangle of R. qd: (n, 1) [rad/s, m/s].
    """
    products = []
    for row, column in model.residuals.entries:
        # An off-diagonal entry occurs twice in R, so the factor 1/2 cancels.
        weight = 0.5 if row == column else 1.0
        products.append(weight * qd[row] * qd[column])
    return ca.vertcat(*products)


def symbol_jacobians(model: TrainedModel, symbols: Symbols) -> list[tuple[ca.SX, ca.SX]]:
    """Return pairs (symbol, Jacobian with respect to q) for the residual terms that depend on q.

    A residual term is a symbol of k entries, (k, 1). Its Jacobian, (k, n), consists of the symbols of its derivatives:
    for example, the Jacobian of ``gravity`` is the symbol ``stiffness``. symbols: the result of `residual_symbols`.
    """
    # A friction factor depends only on the position of its own joint: each row of `joints` selects one joint.
    joints = np.eye(model.n)[list(model.residuals.friction)]
    # `second` is (m, n n): each block of n columns is the Jacobian of one column of `first`.
    by_joint = ca.horzsplit(symbols["second"], model.n)
    jacobians = [
        (symbols["factor"], symbols["factor_slope"] * ca.SX(joints)),
        (symbols["mass"], symbols["first"]),
        (ca.vec(symbols["first"]), ca.vertcat(*by_joint)),
        (symbols["gravity"], symbols["stiffness"]),
        (symbols["torque"], ca.diag(symbols["torque_slope"])),
    ]
    # Residual terms that the model does not have are structural zeros and are omitted.
    return [(symbol, jacobian) for symbol, jacobian in jacobians if symbol.nnz()]
