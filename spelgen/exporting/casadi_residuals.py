"""What stands beside rigid bodies as CasADi expressions of matrices, from which CasADi derives what is needed."""

from __future__ import annotations

import casadi as ca
import numpy as np

from spelgen.exporting.description import Encoding, Network, Residuals, Splines, TrainedModel
from spelgen.exporting.residual_expressions import entry_places


def residual_values(model: TrainedModel, q: ca.MX, qd: ca.MX | None) -> dict[str, ca.MX]:
    """Values and rates at q by their names in ``ResidualSymbols``."""
    residuals, n, found = model.residuals, model.n, {}
    places, read = entry_places(model), _encoded(residuals.encoding, q)
    if residuals.mass is not None:
        mass = found["mass"] = _network(residuals.mass, [row * n + column for row, column in places], read)
        if qd is not None:
            found["rate"] = ca.jtimes(mass, q, qd)
            squares = [(0.5 if row == column else 1.0) * qd[row] * qd[column] for row, column in places]
            found["kinetic"] = ca.jtimes(mass, q, ca.vertcat(*squares), True)
    if residuals.potential is not None:
        found["energy"] = _network(residuals.potential, [0], read)
        found["gravity"] = ca.gradient(found["energy"], q)
    if residuals.has_torque:
        energy = found["torque_energy"] = _torque_energy(residuals, q)
        found["torque"] = ca.gradient(energy, q)
    if residuals.friction.joints:
        found["factor"] = _spline_values(residuals.friction, q)
    return found


def _encoded(encoding: Encoding, q: ca.MX) -> ca.MX:
    """What networks read of q."""
    parts = [ca.cos(q), ca.sin(q)]
    if encoding.prismatic:
        parts.append((q - encoding.center) / encoding.reach)
    return ca.vertcat(*parts)


def _network(network: Network, rows: list[int], read: ca.MX) -> ca.MX:
    layer = read
    for weight, bias in zip(network.weights[:-1], network.biases, strict=False):
        layer = 1 / (1 + ca.exp(-(_sparse(weight) @ layer + bias)))
    return _sparse(network.weights[-1][rows]) @ layer + network.biases[-1][rows]


def _torque_energy(residuals: Residuals, q: ca.MX) -> ca.MX:
    """V of single joints. What ends where a spline does is, as in the runtime, half on either side of it."""
    energy, splines = ca.MX(0), residuals.torque
    if splines.joints:
        place = _places(splines, q)
        wide, narrow = (ca.fmin(ca.fmax(place, -size), size) for size in (2, 1))
        part = _cubic_integral(wide, 2) / 6 - _cubic_integral(narrow, 1) * (4 / 6)
        energy += ca.dot((splines.weights * splines.spacing[:, None]).ravel(), part)
    for each in residuals.ripple:
        frequencies = each.frequency * np.arange(1, len(each.cosines) + 1)
        phase = frequencies * q[each.joint]
        energy += ca.dot(each.cosines / frequencies, ca.sin(phase)) - ca.dot(
            each.sines / frequencies, ca.cos(phase)
        )
    return energy


def _spline_values(splines: Splines, q: ca.MX) -> ca.MX:
    """(joints, 1)."""
    away = ca.fabs(_places(splines, q))
    height = (ca.fmax(2 - away, 0) ** 3 - 4 * ca.fmax(1 - away, 0) ** 3) / 6
    weights = (
        np.kron(np.eye(len(splines.joints)), np.ones(splines.weights.shape[1])) * splines.weights.ravel()
    )
    return _sparse(weights) @ height


def _places(splines: Splines, q: ca.MX) -> ca.MX:
    """How far q is from each spline's middle, in spacings, (joints S, 1)."""
    size = splines.weights.shape[1]
    scaled = (q[list(splines.joints)] - splines.center) / splines.spacing
    knots = np.tile(np.arange(size) - (size - 1) / 2, len(splines.joints))
    return ca.vec(ca.repmat(scaled.T, size, 1)) - knots


def _cubic_integral(x: ca.MX, size: float) -> ca.MX:
    """The integral from zero to x of (size - |x|)^3."""
    away = ca.fabs(x)
    return x * (size**3 - 1.5 * size**2 * away + size * away**2 - 0.25 * away**3)


def _sparse(matrix: np.ndarray) -> ca.DM:
    return ca.sparsify(ca.DM(matrix))
