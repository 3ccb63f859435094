"""Residual terms of a model, as CasADi symbols and as CasADi expressions of q.

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

from __future__ import annotations

from typing import TypeVar

import casadi as ca
import numpy as np
from scipy.interpolate import BSpline

from spelgen.exporting.description import Residuals, SigmoidNetwork, TrainedModel, spline_energy
from spelgen.exporting.rigid_expressions import constant

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
        # directional derivatives: a program computes them in one sweep, without all n columns of first
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
    kinetic = symbols["first"].T @ _in_kinetic_energy(model, qd)
    return symmetric(model, symbols["first"] @ qd) @ qd - kinetic


def _in_kinetic_energy(model: TrainedModel, qd: Scalars) -> Scalars:
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


def residual_values(model: TrainedModel, q: ca.MX, qd: ca.MX | None) -> dict[str, ca.MX]:
    """Return expressions for the symbols, without derivatives, at q and qd (n, 1); qd: None if not needed."""
    residuals = model.residuals
    values: dict[str, ca.MX] = {}
    encoded = ca.vertcat(ca.cos(q), ca.sin(q), q)
    if residuals.mass is not None:
        mass = values["mass"] = _network(residuals.mass, encoded)
        if qd is not None:
            values["rate"] = ca.jtimes(mass, q, qd)
            values["kinetic"] = ca.jtimes(mass, q, _in_kinetic_energy(model, qd), True)
    if residuals.potential is not None:
        values["energy"] = _network(residuals.potential, encoded)
        # reverse mode: takes about the time of the network
        values["gravity"] = ca.gradient(values["energy"], q)
    if residuals.has_torque:
        values["torque_energy"] = _torque_energy(residuals, q)
        values["torque"] = ca.gradient(values["torque_energy"], q)
    if residuals.friction:
        factors = [_spline(spline, q[joint]) for joint, spline in residuals.friction.items()]
        values["factor"] = ca.vertcat(*factors)
    return values


def _network(network: SigmoidNetwork, encoded: ca.MX) -> ca.MX:
    """Return the outputs, (outputs, 1), for inputs (3 n, 1)."""
    layer = encoded
    for weight, bias in zip(network.weights[:-1], network.biases[:-1], strict=True):
        # the sigmoid, which CasADi does not have
        layer = 1 / (1 + ca.exp(-(constant(weight) @ layer + bias)))
    return constant(network.weights[-1]) @ layer + network.biases[-1]


def _torque_energy(residuals: Residuals, q: ca.MX) -> ca.MX:
    """Return the potential energy of functions of single joints, (1, 1) [J], at q (n, 1)."""
    energy = ca.MX(0)
    for joint, spline in residuals.torque.items():
        energy += _spline(spline_energy(spline), q[joint])
    for ripple in residuals.ripple:
        frequencies = ripple.frequency * np.arange(1, len(ripple.cosines) + 1)
        phase = frequencies * q[ripple.joint]
        energy += ca.dot(ripple.cosines / frequencies, ca.sin(phase))
        energy -= ca.dot(ripple.sines / frequencies, ca.cos(phase))
    return energy


def _spline(spline: BSpline, q: ca.MX) -> ca.MX:
    """Return the value at q, (1, 1); outside of the knots it is constant."""
    knots, degree = spline.t, spline.k
    inside = ca.fmin(ca.fmax(q, knots[degree]), knots[-degree - 1])
    return ca.bspline(inside, ca.DM(spline.c), [knots.tolist()], [degree], 1, {})
