"""What a deployed model can be asked: one list for C, CasADi and the others, each as a CasADi function."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields

import casadi as ca

from spelgen.exporting.description import TrainedModel
from spelgen.exporting.model_expressions import ModelExpressions
from spelgen.exporting.residual_expressions import Level
from spelgen.exporting.tip_expressions import tip


@dataclass(frozen=True)
class EntryPoint:
    """A question: what is given, and what is answered (name, unit).

    ``inputs`` are among q, qd, qdd, tau, u, dq (n rows) and z (friction's memory).
    """

    name: str
    about: str
    inputs: tuple[str, ...]
    outputs: tuple[tuple[str, str], ...]
    level: Level
    expressions: Callable[[ModelExpressions], tuple[ca.SX, ...]]


RESIDUAL = "residual_"  # before the names of what is given of residuals
_TORQUE, _MASS = "Nm, N", "kg m^2, kg m, kg"

ENTRY_POINTS = (
    EntryPoint(
        "inverse_dynamics", "the torques that give qdd, friction included", ("q", "qd", "qdd", "z"),
        (("tau", _TORQUE),), "rates", lambda m: (m.inverse_dynamics,),
    ),
    EntryPoint(
        "forward_dynamics", "the accelerations under the torques tau", ("q", "qd", "tau", "z"),
        (("qdd", "rad/s^2, m/s^2"),), "rates", lambda m: (m.forward_dynamics,),
    ),
    EntryPoint(
        "mass_matrix", "M, armature included", ("q",),
        (("mass", _MASS),), "values", lambda m: (m.mass_matrix,),
    ),
    EntryPoint(
        "bias", "Coriolis, centrifugal and gravity torques", ("q", "qd"),
        (("bias", _TORQUE),), "rates", lambda m: (m.bias,),
    ),
    EntryPoint(
        "gravity", "the torques that hold the arm still, dV/dq", ("q",),
        (("gravity", _TORQUE),), "rates", lambda m: (m.gravity,),
    ),
    EntryPoint(
        "friction", "what friction takes", ("q", "qd", "z"),
        (("friction", _TORQUE),), "rates", lambda m: (m.friction,),
    ),
    EntryPoint(
        "friction_step", "friction's memory after each joint went one way by dq", ("z", "dq"),
        (("z_next", "rad, m"),), "values", lambda m: (m.friction_step,),
    ),
    EntryPoint(
        "friction_memory", "friction's memory of joints that have long gone the way of qd: to start from", ("qd",),
        (("z_start", "rad, m"),), "values", lambda m: (m.friction_memory,),
    ),
    EntryPoint(
        "momentum", "M qd", ("q", "qd"),
        (("momentum", "Nm s, N s"),), "values", lambda m: (m.momentum,),
    ),
    EntryPoint(
        "energy", "kinetic energy, then potential", ("q", "qd"),
        (("energy", "J"),), "values", lambda m: (m.energy,),
    ),
    EntryPoint(
        "tip_pose", "the tip's homogeneous transform in the root link's frame", ("q",),
        (("pose", "1, m"),), "values", lambda m: (tip(m.model, m.q)[0],),
    ),
    EntryPoint(
        "tip_jacobian", "the tip's linear, then angular velocity by qd, in the root link's axes", ("q",),
        (("jacobian", "m, 1"),), "values", lambda m: (tip(m.model, m.q)[1],),
    ),
    EntryPoint(
        "inverse_dynamics_derivatives", "how inverse_dynamics changes; with qdd it does by the mass matrix",
        ("q", "qd", "qdd", "z"), (("dtau_dq", "Nm/rad"), ("dtau_dqd", "Nm s/rad")), "jets",
        lambda m: m.inverse_dynamics_derivatives(),
    ),
    EntryPoint(
        "forward_dynamics_derivatives", "how forward_dynamics changes", ("q", "qd", "tau", "z"),
        (("dqdd_dq", "1/s^2"), ("dqdd_dqd", "1/s"), ("dqdd_dtau", "1/(kg m^2)")), "jets",
        lambda m: m.forward_dynamics_derivatives(),
    ),
)  # fmt: skip


SERVO = EntryPoint(
    "servo_torque", "what position servos give under a command u, delayed as it was found", ("u", "q", "qd"),
    (("tau", _TORQUE),), "values", lambda m: (m.servo_torque,),
)  # fmt: skip


def entry_points(model: TrainedModel) -> tuple[EntryPoint, ...]:
    """What this model can be asked."""
    return ENTRY_POINTS if model.servos is None else (*ENTRY_POINTS, SERVO)


def expression_function(entry: EntryPoint, model: TrainedModel) -> ca.Function:
    """The entry point as a function of its inputs, then of what it needs of the residuals; outputs are dense."""
    made = ModelExpressions(model, entry.level)
    outputs = [ca.densify(each) for each in entry.expressions(made)]
    inputs = {name: getattr(made, name) for name in entry.inputs}
    every = ca.vertcat(*(ca.vec(each) for each in outputs))
    for field in fields(made.residuals):
        symbols = getattr(made.residuals, field.name)
        if symbols.numel() and ca.depends_on(every, symbols):
            inputs[f"{RESIDUAL}{field.name}"] = symbols
    names = [name for name, _ in entry.outputs]
    return ca.Function(entry.name, list(inputs.values()), outputs, list(inputs), names, {"cse": True})


def residuals_needed(function: ca.Function) -> list[str]:
    """What an ``expression_function`` is given of the residuals."""
    return [name.removeprefix(RESIDUAL) for name in function.name_in() if name.startswith(RESIDUAL)]
