"""Export of the estimator of payload, friction drift and external torques: a C header and a C source.

Both files are added to the C files of the model. The noise levels estimated from the training logs are constants in the
C code. Functions that only the estimator calls are generated from CasADi expressions, with the formulas of
`live.momentum`.
"""

import math
import zlib
from collections.abc import Iterable

import casadi as ca
import numpy as np

from spelgen.exporting.c_source import CFunction, c_function
from spelgen.exporting.describe import TrainedModel
from spelgen.exporting.model_expressions import drive_friction, joint_mass, named_function, residual_symbols
from spelgen.exporting.parity import TORQUE, entry_point
from spelgen.exporting.rigid_expressions import RigidBodies, constant, frame_kinematics
from spelgen.live.noise import BlockNoise, NoiseLevels
from spelgen.live.tuning import TUNING
from spelgen.templates import render

CALLED = ("inverse_dynamics", "friction", "gravity")
"""Functions of the model that the estimator calls, in addition to its own."""

_ENTRIES = (
    entry_point(
        "momentum_balance",
        "the terms of d/dt (p + P load) = torque - friction + N load, of an arm with a payload, and the tip's Jacobian",
        "q qd tau low high", momentum="Nm s, N s", torque=TORQUE, friction=TORQUE, uncertainty=TORQUE,
        load_momentum="SI", load_torque="SI", jacobian="m, 1",
    ),
    entry_point(
        "payload_torque", "the torques that move a payload with ten inertial parameters at the last body",
        "q qd qdd load", tau=TORQUE,
    ),
)  # fmt: skip


def estimator_c_functions(model: TrainedModel, levels: NoiseLevels) -> list[CFunction]:
    """Return the two C functions that only the estimator of payload and external torques calls.

    ``momentum_balance`` computes the terms of the momentum balance, ``payload_torque`` the joint torques due to a
    payload. model: the model as NumPy arrays. levels: noise levels; ``levels.point``, the tip in the frame of the last
    body, is a constant in the C code.
    """
    n, bodies = model.n, model.arm.bodies
    sizes = {"q": n, "qd": n, "qdd": n, "tau": n, "load": 10, "low": model.memory, "high": model.memory}
    inputs = {name: ca.SX.sym(name, size) for name, size in sizes.items()}
    q, qd, qdd, tau, load, low, high = inputs.values()
    residuals, still = residual_symbols(model), ca.SX(n, 1)
    arm = RigidBodies(model.arm, q, model.inertias)
    # The payload is represented by a second set of bodies, in which only the last body has inertial parameters. The
    # momentum and the torque of this set are linear in these ten parameters.
    last = model.arm.load_body
    payload = RigidBodies(model.arm, q, [load if k == last else ca.SX(10, 1) for k in range(len(bodies))])
    momentum, kinetic_gradient = arm.momentum(qd)
    momentum += joint_mass(model, residuals) @ qd
    gravity = arm.torque(still, still)
    gradient = kinetic_gradient + residuals["kinetic"] - gravity - residuals["gravity"] - residuals["torque"]
    applied = constant(model.inputs) @ (tau - model.torque_offset)
    torque = applied + constant(model.friction_compensation) * qd + gradient
    # The estimator only knows an interval [low, high] of the friction state z. The estimated friction is the mean of
    # the friction torques at both ends of the interval; its uncertainty is half their difference.
    first, second = (drive_friction(model, residuals, qd, gravity, z) for z in (high, low))
    # Pose and Jacobian of the last body's frame relative to the root frame. The Jacobian has three rows of linear
    # velocity, then three rows of angular velocity.
    pose, jacobian = frame_kinematics(bodies, last, np.eye(4), q)
    load_momentum, load_gradient = payload.momentum(qd)
    load_gradient -= payload.torque(still, still)
    at_point = jacobian[:3, :] - ca.skew(pose[:3, :3] @ levels.point) @ jacobian[3:, :]
    outputs = {
        "momentum_balance": (
            momentum, torque, (first + second) / 2, ca.fabs(first - second) / 2,
            ca.jacobian(load_momentum, load), ca.jacobian(load_gradient, load), at_point,
        ),
        "payload_torque": (payload.torque(qd, qdd),),
    }  # fmt: skip
    return [
        c_function(model, entry, named_function(entry, outputs[entry.name], inputs, residuals))
        for entry in _ENTRIES
    ]


def estimator_texts(model: TrainedModel, levels: NoiseLevels) -> dict[str, str]:
    """Return {file name: text} of the C header and source of the estimator of payload and external torques.

    levels: noise levels, which are constants in the C code.
    """
    tables: dict[str, Iterable[float]] = {
        "load_prior": TUNING.load_prior,
        "scales": TUNING.scales,
        # C has no empty arrays, so a model without bristles gets one unused break-away displacement, zero.
        "breakaway": model.breakaway.ravel() if model.memory else [0.0],
        "rest_speed": levels.rest_speed,
        "saturation": levels.effort * levels.saturation,
    }
    for name, level in levels:
        if isinstance(level, BlockNoise):
            tables |= {f"{name}_{key}": row for key, row in level}
        elif name not in ("minutes", "point", "peak_count", "load_freedom", "delay", "saturation"):
            tables[name] = np.ravel(level)
    values = {
        "name": model.name,
        "upper": model.name.upper(),
        "n": model.n,
        "tuning": TUNING,
        "levels": levels,
        "tables": {name: _numbers(row) for name, row in tables.items()},
        "motors": list(map(_numbers, model.motors)),
        "inverse_inputs": list(map(_numbers, model.input_inverse)),
        # origin and axes of the tip link in the frame of the last body, if it is a part of this body
        "tip": (np.round(model.tip.pose[:3, [3, 0, 1, 2]].T, 9) + 0.0).tolist(),
        "tip_is_last": model.tip.carrier == model.arm.load_body,
    }
    # The generated C code contains a checksum of all constants. A saved state of the estimator has this checksum, too:
    # the code refuses a state that was saved with other constants.
    identity = zlib.crc32(repr(sorted((name, str(value)) for name, value in values.items())).encode())
    return {
        f"{model.name}_estimator{suffix}": render(f"estimator{suffix}.jinja", **values, identity=identity)
        for suffix in (".h", ".c")
    }


def _numbers(values: Iterable[float]) -> list[str]:
    """Return the values as C literals that give exactly the same doubles."""
    return ["INFINITY" if math.isinf(value) else repr(float(value)) for value in values]
