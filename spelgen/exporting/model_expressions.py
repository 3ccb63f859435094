"""CasADi expressions of the functions of a trained model (entry points), for example of inverse dynamics.

The variables of an expression are the inputs of the entry point, for example q and qd, and symbols that represent the
residual terms, so that exported code can compute these terms by loops over network weights and lookup of splines. R is
the part of M that a network computes, with m nonzero entries in the lower triangle; k is the number of joints whose
friction depends on q. The symbols of residual terms are:

- ``mass`` (m, 1), entries of R; ``rate`` (m, 1), d mass / dt; ``kinetic`` (n, 1), d/dq of 1/2 qd^T R qd;
- ``energy`` (1, 1), the network of the potential energy V; ``gravity`` (n, 1), d energy / dq;
- ``torque`` (n, 1), torques that depend on the position of a single joint; ``torque_energy`` (1, 1), their energy;
- ``factor`` (k, 1), logarithms of the friction factors.
"""

from collections.abc import Mapping

import casadi as ca
import numpy as np

from spelgen.exporting.describe import Servos, TrainedModel
from spelgen.exporting.parity import EntryPoint
from spelgen.exporting.rigid_expressions import RigidBodies, constant, frame_kinematics, mass_and_potential

Symbols = dict[str, ca.SX]
RESIDUAL = "residual_"
"""Prefix of the names of residual terms among the inputs of a function."""


def expression_functions(model: TrainedModel, entries: Mapping[str, EntryPoint]) -> dict[str, ca.Function]:
    """Return {name of an entry point, such as inverse_dynamics: CasADi function of scalar expressions}.

    The inputs of a function are the inputs of the entry point, then the values of the residual terms on which it
    depends (see the module): other code computes these values from q and qd. The outputs are dense.
    """
    names = ("q", "qd", "qdd", "tau", "dq", "u")
    inputs = {name: ca.SX.sym(name, model.n) for name in names}
    inputs["z"] = ca.SX.sym("z", model.memory)
    # The expressions of all entry points are built together, since they share subexpressions.
    residuals = residual_symbols(model)
    expressions = _expressions(model, inputs, residuals)
    functions = {}
    for name, entry in entries.items():
        functions[name] = named_function(entry, (expressions[name],), inputs, residuals)
    return functions


def named_function(
    entry: EntryPoint, expressions: tuple[ca.SX, ...], inputs: Symbols, residuals: Symbols
) -> ca.Function:
    """Return the CasADi function of an entry point (such as inverse_dynamics) for its expressions, with dense outputs.

    Its inputs are the inputs of the entry point, then the residual terms on which the expressions depend.

    Args:
        entry: the entry point.
        expressions: expression of each output.
        inputs: {name: symbol} of all inputs of entry points.
        residuals: {name: symbol} of the residual terms, see ``residual_symbols``.
    """
    outputs = list(map(ca.densify, expressions))
    arguments = {key: inputs[key] for key in entry.inputs}
    for key, symbols in residuals.items():
        if symbols.nnz() and ca.depends_on(ca.veccat(*outputs), symbols):
            arguments[RESIDUAL + key] = symbols
    labels = list(arguments), list(entry.outputs)
    # With the option cse of CasADi, common subexpressions are computed once.
    return ca.Function(entry.name, list(arguments.values()), outputs, *labels, {"cse": True})


def residuals_needed(function: ca.Function) -> list[str]:
    """Return the names of the residual terms on which a function made by ``expression_functions`` depends."""
    return [name.removeprefix(RESIDUAL) for name in function.name_in() if name.startswith(RESIDUAL)]


def residual_symbols(model: TrainedModel) -> Symbols:
    """Return {name: CasADi symbol} of all residual terms of a model; absent terms are structural zeros."""
    n = model.n
    residuals = model.residuals
    entries, factors = len(residuals.entries), len(residuals.friction)
    has_potential = residuals.potential is not None
    # {name: (nonzero or True if the model has this term, number of rows of its symbol)}. `entries` and `factors` are
    # numbers that are 0 without the term.
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


def _expressions(model: TrainedModel, inputs: Symbols, residuals: Symbols) -> dict[str, ca.SX]:
    """Return {name of an entry point: expression} for all entry points of the model.

    The model is M(q) qdd + h(q, qd) + friction = G (tau - offset) + compensation, with the input matrix G, the
    measured torque ``offset`` at zero torque, and the torque ``compensation`` that the drives add.

    Args:
        model: the model as NumPy arrays.
        inputs: symbols q, qd, qdd, tau, dq (displacement), u (command of servos), (n, 1) each, and z, (n K, 1), the
            friction state of K bristles per joint.
        residuals: symbols of the residual terms, see ``residual_symbols``.
    """
    q, qd, qdd, tau, dq, u, z = inputs.values()
    standstill = ca.SX(model.n, 1)
    motors = constant(model.motors)
    bodies = RigidBodies(model.arm, q, model.inertias)
    rigid_mass, rigid_potential = mass_and_potential(model, q)
    added_mass = joint_mass(model, residuals)
    mass = rigid_mass + added_mass
    rigid_gravity = bodies.torque(standstill, standstill)
    added_gravity = added_bias = residuals["gravity"] + residuals["torque"]
    if model.residuals.mass is not None:
        # Coriolis torque of R, the residual term of M: dR/dt qd - d/dq (1/2 qd^T R qd)
        added_bias = added_gravity + symmetric(model, residuals["rate"]) @ qd - residuals["kinetic"]
    bias = bodies.torque(qd, standstill) + added_bias
    friction = drive_friction(model, residuals, qd, rigid_gravity, z)
    compensation = constant(model.friction_compensation) * qd
    # One pass of the Newton-Euler algorithm computes the sum M qdd + h of the rigid bodies; M qdd and h separately
    # would take two.
    force = bodies.torque(qd, qdd) + added_mass @ qdd + added_bias + friction - compensation
    to_inputs = constant(model.input_inverse)
    applied = constant(model.inputs) @ (tau - model.torque_offset)
    # The kinetic energy is 1/2 qd . momentum, so that the product with M is computed once.
    momentum = mass @ qd
    potential = rigid_potential + residuals["energy"] + residuals["torque_energy"]
    pose, jacobian = frame_kinematics(model.tip.chain.bodies, model.tip.carrier, model.tip.pose, q)
    outputs = {
        "inverse_dynamics": to_inputs @ force + model.torque_offset,
        "forward_dynamics": _solve(mass, applied + compensation - bias - friction),
        "mass_matrix": mass,
        "bias": bias,
        "gravity": rigid_gravity + added_gravity,
        "friction": friction,
        "friction_step": bristle_step(model.breakaway, z, motors @ dq),
        "friction_memory": sliding_bristles(model, motors @ qd),
        "momentum": momentum,
        "energy": ca.vertcat(0.5 * ca.dot(qd, momentum), potential),
        "tip_pose": pose,
        "tip_jacobian": jacobian,
    }
    if model.servos is not None:
        outputs["servo_torque"] = _servo_torque(model.servos, u, q, qd)
    return outputs


def joint_mass(model: TrainedModel, residuals: Symbols) -> ca.SX:
    """Return the part of the mass matrix M that is due to rotors and residual terms, (n, n)."""
    return constant(model.constant_mass) + symmetric(model, residuals["mass"])


def drive_friction(model: TrainedModel, residuals: Symbols, qd: ca.SX, gravity: ca.SX, z: ca.SX) -> ca.SX:
    """Return joint friction torques, (n, 1) [Nm, N], of drives whose friction depends on speed, load and history.

    Args:
        model: the model as NumPy arrays.
        residuals: symbols of the residual terms, for the factors on friction.
        qd: joint velocities, (n, 1).
        gravity: gravity torques of the rigid bodies, (n, 1) [Nm, N].
        z: friction state of K bristles per joint, (n K, 1).
    """
    motors = constant(model.motors)
    # C is the matrix `motors`: the motor speeds are C qd. Power is equal at motors and joints, so the gravity torques
    # ``load`` of the motors satisfy C^T load = gravity.
    load = constant(np.linalg.inv(model.motors).T) @ gravity
    friction = friction_torque(model, motors @ qd, load, z)
    for k, joint in enumerate(model.residuals.friction):
        friction[joint] *= ca.exp(residuals["factor"][k])
    return motors.T @ friction


def friction_torque(model: TrainedModel, qd: ca.SX, gravity: ca.SX, z: ca.SX) -> ca.SX:
    """Return the friction torque of the motors, (n, 1) [Nm, N], by the formulas of ``runtime.friction_laws``.

    Args:
        model: the model as NumPy arrays.
        qd: velocities of the motors, (n, 1) [rad/s, m/s].
        gravity: gravity torques of the motors, (n, 1) [Nm, N].
        z: friction state of K bristles per joint, (n K, 1), the bristles of the first joint first.
    """
    constants = model.friction
    # ca.reshape is column-major, so that each column has the K bristles of a joint.
    deflection = ca.reshape(
        z * (constants.bristle_fractions / model.breakaway).ravel(), model.breakaway.shape[1], model.n
    )
    # The direction of dry friction is between -1 and 1. At joints without bristles (`memoryless` is 1), it is the
    # smooth sign of the velocity. At other joints (`memoryless` is 0), it is the mean of the bristle deflections z,
    # divided by the break-away displacements, with the weights `bristle_fractions`, whose sum is 1. `deflection`
    # contains the weighted deflections.
    direction = constants.memoryless * _smooth_sign(qd, constants.coulomb_smoothing_velocity)
    direction += ca.sum1(deflection).T
    load = ca.sqrt(gravity**2 + constants.min_load**2)
    speed = ca.fabs(qd) / constants.stribeck_velocity
    rounding = constants.stribeck_rounding
    slow = 1 / (1 + (1 + rounding) / 8 * speed**2 / (speed + rounding))
    for _ in range(3):  # slow^8 = (1 + x / 8)^-8 is close to exp(-x), the Stribeck curve
        slow = slow * slow
    dry = constants.coulomb + constants.load_dependence * load + constants.stribeck * slow
    viscous = constants.viscous * qd + constants.saturation * _smooth_sign(qd, constants.saturation_velocity)
    return ca.SX(viscous + dry * direction)


def _smooth_sign(velocity: ca.SX, width: np.ndarray) -> ca.SX:
    """Return v / sqrt(v^2 + width^2), the smooth sign of velocities v, (n, 1).

    width: velocity at which the sign is 1 / sqrt(2), (n,).
    """
    return velocity / ca.sqrt(velocity**2 + width**2)


def sliding_bristles(model: TrainedModel, qd: ca.SX) -> ca.SX:
    """Return the friction state z, (n K, 1), of motors with K bristles that move at constant velocities qd, (n, 1)."""
    direction = ca.tanh(qd / model.friction.coulomb_smoothing_velocity)
    return ca.SX(_per_element(model.breakaway, direction) * model.breakaway.ravel())


def bristle_step(breakaway: np.ndarray, z: ca.SX, dq: ca.SX) -> ca.SX:
    """Return the friction state z, (n K, 1), after a displacement of the motors without reversals: z + dq, clipped.

    Args:
        breakaway: break-away displacements of K bristles per motor, (n, K) [rad, m].
        z: friction state before the displacement, (n K, 1) [rad, m].
        dq: displacements of the motors, (n, 1) [rad, m].
    """
    limit = breakaway.ravel()
    return ca.SX(ca.fmin(ca.fmax(z + _per_element(breakaway, dq), -limit), limit))


def _per_element(breakaway: np.ndarray, values: ca.SX) -> ca.SX:
    """Return the values (n, 1) of n motors repeated for each of their K bristles, (n K, 1); ``breakaway``: (n, K)."""
    return ca.vec(ca.repmat(values.T, breakaway.shape[1], 1))


def _servo_torque(servos: Servos, u: ca.SX, q: ca.SX, qd: ca.SX) -> ca.SX:
    """Return the torque of position servos, (n, 1) [Nm, N], at positions q and velocities qd, (n, 1) each.

    u: delayed commands, (n, 1) [rad, m].
    """
    error = u - q
    if servos.dead_zone.any():
        error -= ca.fmin(ca.fmax(error, -servos.dead_zone), servos.dead_zone)
    torque: ca.SX = servos.kp * error - servos.kd * qd
    # Joints without a torque limit are skipped, which saves comparisons in C.
    for joint in np.flatnonzero(np.isfinite(servos.limit)).tolist():
        limit = servos.limit[joint]
        torque[joint] = ca.fmin(ca.fmax(torque[joint], -limit), limit)
    return torque


def _solve(matrix: ca.SX, right: ca.SX) -> ca.SX:
    """Return matrix^-1 right, (n, columns), by an L D L^T decomposition of a positive definite matrix (n, n).

    The lower triangle of the matrix is not used, so CasADi does not compute it. For n = 6, this needs 6 divisions,
    ``ca.ldl`` 21.
    """
    n = matrix.shape[0]
    # The elimination changes matrices in place, so it works on copies.
    matrix = ca.SX(matrix)
    right = ca.SX(right)
    factors = []
    for k in range(n):
        inverse = 1 / matrix[k, k]
        row = matrix[k, k + 1 :]
        factor = inverse * row
        # The remaining block becomes the Schur complement of the pivot. A positive definite matrix needs no
        # pivoting.
        matrix[k + 1 :, k + 1 :] -= factor.T @ row
        right[k + 1 :, :] -= factor.T @ right[k, :]
        right[k, :] *= inverse
        factors.append(factor)
    for k in reversed(range(n)):
        right[k, :] -= factors[k] @ right[k + 1 :, :]
    return right
