"""Residual terms of a model as CasADi symbols.

Scalar expressions of a model contain residual terms as symbols, so that a program can compute them by loops over
weights and lookup of splines. The symbols are, for R the part of M that the network of M adds to (m entries of its
lower triangle), and k joints whose friction varies with q:

- ``mass`` (m, 1), entries of R; ``rate`` (m, 1), their time derivatives; ``kinetic`` (n, 1), d/dq of 1/2 qd^T R qd;
- ``energy`` and ``gravity`` (n, 1), the network of V and its derivative with respect to q;
- ``torque`` (n, 1) and ``torque_energy``, functions of single joints and their integral;
- ``factor`` (k, 1), logarithms of the factors on friction.

Derivatives need ``first`` (m, n) and ``second`` (m, n n) instead of rate and kinetic: derivatives of mass with respect
to q, second derivatives in blocks of n columns per joint. They also need ``stiffness`` (n, n), d gravity / dq, and the
derivatives ``torque_slope`` and ``factor_slope`` with respect to the position of the joint.
"""

from typing import TypeVar

import casadi as ca
import numpy as np

from spelgen.exporting.description import TrainedModel

Symbols = dict[str, ca.SX]
Scalars = TypeVar("Scalars", ca.SX, ca.MX)


def residual_symbols(model: TrainedModel) -> Symbols:
    """Return the symbols by name; structural zeros for terms that the model does not have."""
    n = model.n
    residuals = model.residuals
    entries, factors = len(residuals.entries), len(residuals.friction)
    has_potential = residuals.potential is not None
    sizes = {
        "mass": (entries, entries, 1),
        # directional derivatives: a program computes them in one sweep, without the n columns of the symbol `first`
        "rate": (entries, entries, 1),
        "kinetic": (entries, n, 1),
        # for derivatives of forces
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
    symbols: Symbols = {}
    for name, (exists, *size) in sizes.items():
        symbols[name] = ca.SX.sym(name, *size) if exists else ca.SX(*size)
    return symbols


def symmetric(model: TrainedModel, values: ca.SX) -> ca.SX:
    """Return the symmetric matrix, (n, n), with values (m, 1) at the entries of R."""
    matrix = ca.SX(model.n, model.n)
    for k, (row, column) in enumerate(model.residuals.entries):
        matrix[row, column] = matrix[column, row] = values[k]
    return matrix


def coriolis(model: TrainedModel, symbols: Symbols, qd: ca.SX, *, derivatives: bool) -> ca.SX:
    """Return dR/dt qd - d/dq (1/2 qd^T R qd), (n, 1); qd: (n, 1). derivatives: whether ``first`` replaces rate."""
    if not derivatives:
        return symmetric(model, symbols["rate"]) @ qd - symbols["kinetic"]
    kinetic = symbols["first"].T @ in_kinetic_energy(model, qd)
    return symmetric(model, symbols["first"] @ qd) @ qd - kinetic


def in_kinetic_energy(model: TrainedModel, qd: Scalars) -> Scalars:
    """Return the factor of each entry of R in 1/2 qd^T R qd, (m, 1); qd: (n, 1)."""
    products = []
    for row, column in model.residuals.entries:
        # an off-diagonal entry occurs twice in R
        weight = 0.5 if row == column else 1.0
        products.append(weight * qd[row] * qd[column])
    return ca.vertcat(*products)


def symbol_jacobians(model: TrainedModel, symbols: Symbols) -> list[tuple[ca.SX, ca.SX]]:
    """Return the symbols that depend on q, (k, 1) each, with their derivatives with respect to q, (k, n)."""
    # the friction factor of a joint depends on the position of this joint only
    joints = np.eye(model.n)[list(model.residuals.friction)]
    # second is (m, n n): a block of n columns per joint of the first derivative
    by_joint = ca.horzsplit(symbols["second"], model.n)
    jacobians = [
        (symbols["factor"], symbols["factor_slope"] * ca.SX(joints)),
        (symbols["mass"], symbols["first"]),
        (ca.vec(symbols["first"]), ca.vertcat(*by_joint)),
        (symbols["gravity"], symbols["stiffness"]),
        (symbols["torque"], ca.diag(symbols["torque_slope"])),
    ]
    # without the terms that the model does not have
    return [(symbol, jacobian) for symbol, jacobian in jacobians if symbol.nnz()]
