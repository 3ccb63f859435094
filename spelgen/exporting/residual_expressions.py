"""The part of a model beside its rigid bodies, as CasADi symbols and as CasADi expressions of q.

The scalar expressions of a model take it as symbols, so that a program may loop over weights and look up splines. Of
M's entries that a network reaches (m of them) there are, by name: ``mass`` (m, 1); ``rate``, their change along qd;
``kinetic``, d/dq of their 1/2 qd^T M qd (n, 1); of V's network ``energy`` and ``gravity``, dV/dq (n, 1); of single
joints ``torque`` (n, 1) and ``torque_energy``; of the joints whose friction varies the logarithms ``factor`` (k, 1).

Derivatives need, in place of rate and kinetic, ``first`` (m, n) and ``second`` (m, n n) by q, n columns for each joint;
``stiffness`` (n, n) of V; ``torque_slope`` and ``factor_slope``.
"""

from __future__ import annotations

from typing import TypeVar

import casadi as ca
import numpy as np
from scipy.interpolate import BSpline

from spelgen.exporting.description import Network, Residuals, TrainedModel, spline_energy
from spelgen.exporting.rigid_expressions import constant

Symbols = dict[str, ca.SX]
Scalars = TypeVar("Scalars", ca.SX, ca.MX)


def residual_symbols(model: TrainedModel) -> Symbols:
    """Return symbols for all that a model may have, zeros for what it has not."""
    n = model.n
    residuals = model.residuals
    entries, factors = len(residuals.entries), len(residuals.friction)
    has_potential = residuals.potential is not None
    sizes = {
        "mass": (entries, entries, 1),
        # first derivatives along qd: a program takes them in one sweep, without n^2 numbers
        "rate": (entries, entries, 1),
        "kinetic": (entries, n, 1),
        # jets: second derivatives of forces need these
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
    """Return the symmetric matrix, (n, n), with the values at the entries that the networks' part of M has."""
    matrix = ca.SX(model.n, model.n)
    for k, (row, column) in enumerate(model.residuals.entries):
        matrix[row, column] = matrix[column, row] = values[k]
    return matrix


def coriolis(model: TrainedModel, symbols: Symbols, qd: ca.SX, *, derivatives: bool) -> ca.SX:
    """Return dR/dt qd - d/dq (1/2 qd^T R qd), (n, 1), of the networks' part R of M."""
    if not derivatives:
        return symmetric(model, symbols["rate"]) @ qd - symbols["kinetic"]
    kinetic = symbols["first"].T @ _in_kinetic_energy(model, qd)
    return symmetric(model, symbols["first"] @ qd) @ qd - kinetic


def _in_kinetic_energy(model: TrainedModel, qd: Scalars) -> Scalars:
    """Return what each entry of M is multiplied by in 1/2 qd^T M qd, (entries, 1)."""
    products = []
    for row, column in model.residuals.entries:
        # an entry beside the diagonal stands in M twice
        weight = 0.5 if row == column else 1.0
        products.append(weight * qd[row] * qd[column])
    return ca.vertcat(*products)


def symbol_slopes(model: TrainedModel, symbols: Symbols) -> list[tuple[ca.SX, ca.SX]]:
    """Return the symbols that depend on q, (k, 1) each, with their derivatives by it, (k, n)."""
    # the factor of a joint depends on that joint alone
    joints = np.eye(model.n)[list(model.residuals.friction)]
    by_joint = ca.horzsplit(symbols["second"], model.n)
    slopes = [
        (symbols["factor"], symbols["factor_slope"] * ca.SX(joints)),
        (symbols["mass"], symbols["first"]),
        (ca.vec(symbols["first"]), ca.vertcat(*by_joint)),
        (symbols["gravity"], symbols["stiffness"]),
        (symbols["torque"], ca.diag(symbols["torque_slope"])),
    ]
    # zeros of what a model has not depend on nothing
    return [(symbol, slope) for symbol, slope in slopes if symbol.nnz()]


def residual_values(model: TrainedModel, q: ca.MX, qd: ca.MX | None) -> dict[str, ca.MX]:
    """Return what the symbols stand for at q, without derivatives, as expressions of matrices."""
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
        # reverse sweep of CasADi: as cheap as the network itself
        values["gravity"] = ca.gradient(values["energy"], q)
    if residuals.has_torque:
        values["torque_energy"] = _torque_energy(residuals, q)
        values["torque"] = ca.gradient(values["torque_energy"], q)
    if residuals.friction:
        factors = [_spline(spline, q[joint]) for joint, spline in residuals.friction.items()]
        values["factor"] = ca.vertcat(*factors)
    return values


def _network(network: Network, encoded: ca.MX) -> ca.MX:
    layer = encoded
    for weight, bias in zip(network.weights[:-1], network.biases[:-1], strict=True):
        # CasADi has no sigmoid
        layer = 1 / (1 + ca.exp(-(constant(weight) @ layer + bias)))
    return constant(network.weights[-1]) @ layer + network.biases[-1]


def _torque_energy(residuals: Residuals, q: ca.MX) -> ca.MX:
    """Return V of single joints."""
    energy = ca.MX(0)
    for joint, spline in residuals.torque.items():
        energy += _spline(spline_energy(spline), q[joint])
    for ripple in residuals.ripple:
        frequencies = ripple.frequency * np.arange(1, len(ripple.cosines) + 1)
        # (harmonics,)
        phase = frequencies * q[ripple.joint]
        energy += ca.dot(ripple.cosines / frequencies, ca.sin(phase))
        energy -= ca.dot(ripple.sines / frequencies, ca.cos(phase))
    return energy


def _spline(spline: BSpline, q: ca.MX) -> ca.MX:
    """Return the value at q; beyond the ends it stays as it is there."""
    knots, degree = spline.t, spline.k
    inside = ca.fmin(ca.fmax(q, knots[degree]), knots[-degree - 1])
    return ca.bspline(inside, ca.DM(spline.c), [knots.tolist()], [degree], 1, {})
