"""The quantities of a trained model as CasADi expressions of q, qd and symbols of its residuals."""

from __future__ import annotations

from collections.abc import Mapping

import casadi as ca
import numpy as np

from spelgen.exporting.description import Servos, TrainedModel
from spelgen.exporting.entry_points import EntryPoint
from spelgen.exporting.friction_expressions import bristle_step, friction_torque, sliding_bristles
from spelgen.exporting.residual_expressions import (
    Symbols,
    coriolis,
    residual_symbols,
    symbol_slopes,
    symmetric,
)
from spelgen.exporting.rigid_expressions import (
    body_frames,
    constant,
    mass_and_potential,
    rigid_torque,
    tip_kinematics,
)

RESIDUAL = "residual_"
"""Stands before the names of residuals among a function's inputs."""

Outputs = dict[str, tuple[ca.SX, ...]]


def expression_functions(model: TrainedModel, entries: Mapping[str, EntryPoint]) -> dict[str, ca.Function]:
    """Return entry points as functions of their inputs, then of the residuals that they need; outputs are dense."""
    names = ("q", "qd", "qdd", "tau", "dq", "u")
    inputs = {name: ca.SX.sym(name, model.n) for name in names}
    inputs["z"] = ca.SX.sym("z", model.memory)
    residuals = residual_symbols(model)
    expressions = _expressions(model, inputs, residuals)
    if any(name.endswith("_derivatives") for name in entries):
        expressions |= _derivatives(model, inputs, residuals)
    functions: dict[str, ca.Function] = {}
    for name, entry in entries.items():
        outputs = list(map(ca.densify, expressions[name]))
        arguments = {key: inputs[key] for key in entry.inputs}
        for key, symbols in residuals.items():
            if symbols.nnz() and ca.depends_on(ca.veccat(*outputs), symbols):
                arguments[RESIDUAL + key] = symbols
        labels = list(arguments), list(entry.outputs)
        # what is computed twice becomes one step: by cse
        functions[name] = ca.Function(name, list(arguments.values()), outputs, *labels, {"cse": True})
    return functions


def residuals_needed(function: ca.Function) -> list[str]:
    """Return the names of the residuals that a function of ``expression_functions`` takes."""
    return [name.removeprefix(RESIDUAL) for name in function.name_in() if name.startswith(RESIDUAL)]


def _expressions(
    model: TrainedModel, inputs: Symbols, residuals: Symbols, *, derivatives: bool = False
) -> Outputs:
    """Return all but derivatives by name of the entry point, of M(q) qdd + h(q, qd) + friction = G (tau - offset).

    inputs: symbols of n rows, z of K n. derivatives: whether residuals come with their derivatives by q. ``force`` is
    M qdd + h + friction, less what the drives add unseen, (n, 1).
    """
    q, qd, qdd, tau, dq, u, z = inputs.values()
    standstill = ca.SX(model.n, 1)
    motors = constant(model.motors)
    frames = body_frames(model.arm.bodies, q)
    rigid_mass, rigid_potential = mass_and_potential(model, q)
    # of drives and residuals
    added_mass = constant(model.constant_mass) + symmetric(model, residuals["mass"])
    mass = rigid_mass + added_mass
    rigid_gravity = rigid_torque(model, frames, standstill, standstill)
    added_gravity = added_bias = residuals["gravity"] + residuals["torque"]
    if model.residuals.mass is not None:
        added_bias = added_gravity + coriolis(model, residuals, qd, derivatives=derivatives)
    bias = rigid_torque(model, frames, qd, standstill) + added_bias
    load = constant(np.linalg.inv(model.motors).T) @ rigid_gravity
    drive_friction = friction_torque(model, motors @ qd, load, z)
    for k, joint in enumerate(model.residuals.friction):
        drive_friction[joint] *= ca.exp(residuals["factor"][k])
    friction = motors.T @ drive_friction
    compensation = constant(model.friction_compensation) * qd
    # one pass of Newton and Euler, where M qdd + h would take two
    force = rigid_torque(model, frames, qd, qdd) + added_mass @ qdd + added_bias + friction - compensation
    applied = constant(model.inputs) @ (tau - model.torque_offset)
    momentum = mass @ qd
    potential = rigid_potential + residuals["energy"] + residuals["torque_energy"]
    pose, jacobian = tip_kinematics(model, q)
    outputs = {
        "force": force,
        "inverse_dynamics": _inputs(model, force) + model.torque_offset,
        "forward_dynamics": _solve(mass, applied + compensation - bias - friction),
        "mass_matrix": mass,
        "bias": bias,
        "gravity": rigid_gravity + added_gravity,
        "friction": friction,
        "friction_step": bristle_step(model.reach, z, motors @ dq),
        "friction_memory": sliding_bristles(
            model.reach, model.friction.coulomb_smoothing_velocity, motors @ qd
        ),
        "momentum": momentum,
        "energy": ca.vertcat(0.5 * ca.dot(qd, momentum), potential),
        "tip_pose": pose,
        "tip_jacobian": jacobian,
    }
    if model.servos is not None:
        outputs["servo_torque"] = _servo_torque(model.servos, u, q, qd)
    return {name: (output,) for name, output in outputs.items()}


def _inputs(model: TrainedModel, force: ca.SX) -> ca.SX:
    """Return the inputs that make these forces, (n, columns)."""
    # a passive joint's own torque is what it lacks
    return constant(np.linalg.inv(model.inputs + np.diag(1 - model.actuated))) @ force


def _servo_torque(servos: Servos, u: ca.SX, q: ca.SX, qd: ca.SX) -> ca.SX:
    error = u - q
    if servos.dead_zone.any():
        error -= ca.fmin(ca.fmax(error, -servos.dead_zone), servos.dead_zone)
    torque: ca.SX = servos.kp * error - servos.kd * qd
    for joint in np.flatnonzero(np.isfinite(servos.limit)).tolist():
        limit = servos.limit[joint]
        torque[joint] = ca.fmin(ca.fmax(torque[joint], -limit), limit)
    return torque


def _derivatives(model: TrainedModel, inputs: Symbols, residuals: Symbols) -> Outputs:
    """Return derivatives of inverse and forward dynamics by q, qd and tau, (n, n) each.

    Those of forward dynamics are M^-1 times those of the force at its qdd (Carpentier and Mansard, RSS 2018).
    """
    expressions = _expressions(model, inputs, residuals, derivatives=True)
    (force,), (mass,) = expressions["force"], expressions["mass_matrix"]
    symbols = [inputs["q"]]
    slopes = [ca.SX.eye(model.n)]
    # the chain rule through what the program computes by loops
    for symbol, slope in symbol_slopes(model, residuals):
        symbols.append(symbol)
        slopes.append(slope)
    by_position = ca.jtimes(force, ca.vertcat(*symbols), ca.vertcat(*slopes))
    by_velocity = ca.jacobian(force, inputs["qd"])
    right = ca.horzcat(-by_position, -by_velocity, constant(model.inputs))
    # the derivatives at the acceleration that the torques give
    right = ca.substitute(right, inputs["qdd"], *expressions["forward_dynamics"])
    return {
        "inverse_dynamics_derivatives": (_inputs(model, by_position), _inputs(model, by_velocity)),
        "forward_dynamics_derivatives": tuple(ca.horzsplit(_solve(mass, right), model.n)),
    }


def _solve(matrix: ca.SX, right: ca.SX) -> ca.SX:
    """Return matrix^-1 right by L D L^T, (n, columns); matrix is positive definite.

    Its lower triangle is never read, so that CasADi computes half of it. ``ca.ldl`` divides 21 times where this
    divides 6 times.
    """
    n = matrix.shape[0]
    # copies: they are changed
    matrix = ca.SX(matrix)
    right = ca.SX(right)
    factors: list[ca.SX] = []
    for k in range(n):
        inverse = 1 / matrix[k, k]
        row = matrix[k, k + 1 :]
        factor = inverse * row
        matrix[k + 1 :, k + 1 :] -= factor.T @ row
        right[k + 1 :, :] -= factor.T @ right[k, :]
        right[k, :] *= inverse
        factors.append(factor)
    for k in reversed(range(n)):
        right[k, :] -= factors[k] @ right[k + 1 :, :]
    return right
