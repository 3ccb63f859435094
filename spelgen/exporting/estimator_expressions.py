"""Functions of the C estimator as CasADi expressions, equal to the functions of `live.momentum`."""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca
import numpy as np

from spelgen.exporting.description import TrainedModel
from spelgen.exporting.entry_points import EntryPoint
from spelgen.exporting.model_expressions import drive_friction, named_function
from spelgen.exporting.residual_expressions import residual_symbols, symmetric
from spelgen.exporting.rigid_expressions import body_frames, constant, rigid_momentum, rigid_torque

ENTRIES = (
    EntryPoint(
        "momentum_balance",
        "the terms of d/dt (p + P load) = torque - friction + N load, of an arm with a payload, and the tip's Jacobian",
        ("q", "qd", "tau", "low", "high"),
        {
            "momentum": "Nm s, N s", "torque": "Nm, N", "friction": "Nm, N", "uncertainty": "Nm, N",
            "load_momentum": "SI", "load_torque": "SI", "jacobian": "m, 1",
        },
    ),
    EntryPoint(
        "payload_torque",
        "the torques that move a payload with ten inertial parameters at the last body",
        ("q", "qd", "qdd", "load"),
        {"tau": "Nm, N"},
    ),
)  # fmt: skip

Wrench = tuple[ca.SX, ca.SX]
"""Angular and linear part, (3, 1) each."""


def estimator_functions(model: TrainedModel, point: np.ndarray) -> dict[str, ca.Function]:
    """Return the functions of `ENTRIES` by name; point: of the last body, whose Jacobian is returned, (3,) [m]."""
    sizes = {"q": model.n, "qd": model.n, "qdd": model.n, "tau": model.n, "load": 10}
    sizes |= {"low": model.memory, "high": model.memory}
    inputs = {name: ca.SX.sym(name, size) for name, size in sizes.items()}
    residuals = residual_symbols(model)
    q, qd, qdd, tau, load, low, high = inputs.values()
    frames = body_frames(model.arm.bodies, q)
    momentum, gradient = rigid_momentum(model, frames, qd)
    momentum += (constant(model.constant_mass) + symmetric(model, residuals["mass"])) @ qd
    still = ca.SX(model.n, 1)
    gravity = rigid_torque(model, frames, still, still)
    gradient += residuals["kinetic"] - gravity - residuals["gravity"] - residuals["torque"]
    torque = (
        constant(model.inputs) @ (tau - model.torque_offset)
        + constant(model.friction_compensation) * qd
        + gradient
    )
    first, second = (drive_friction(model, residuals, qd, gravity, z) for z in (high, low))
    axes = _LoadAxes(model, frames, qd)
    outputs = {
        "momentum_balance": (
            momentum, torque, (first + second) / 2, ca.fabs(first - second) / 2, axes.momentum(), axes.torque(),
            axes.jacobian(point),
        ),
        "payload_torque": (axes.inverse_dynamics(qdd, load),),
    }  # fmt: skip
    return {entry.name: named_function(entry, outputs[entry.name], inputs, residuals) for entry in ENTRIES}


class _LoadAxes:
    """Twists of the last body per rate of each body that carries it, and their rates, in its frame; see `LoadAxes`."""

    def __init__(self, model: TrainedModel, frames: Sequence[tuple[ca.SX, ca.SX]], qd: ca.SX) -> None:
        self.model, self.qd = model, qd
        bodies, index = model.arm.bodies, len(model.arm.bodies) - 1
        rotation, position = ca.SX.eye(3), ca.SX(3, 1)
        axes: list[tuple[int, Wrench]] = []
        while index >= 0:
            row = rotation[2, :].T
            if bodies[index].joint_type == "revolute":
                # the velocity of the origin of the last body is z x position
                moved = rotation.T @ ca.vertcat(-position[1], position[0], 0)
                axes.append((index, (row, moved)))
            else:
                axes.append((index, (ca.SX(3, 1), row)))
            turn, shift = frames[index]
            rotation, position = turn @ rotation, turn @ position + shift
            index = bodies[index].parent
        self.rotation = rotation
        self.gravity = rotation.T @ constant(np.array(model.arm.gravity, dtype=float)[:, None])
        self.axes = axes[::-1]
        w, v = ca.SX(3, 1), ca.SX(3, 1)
        self.turning: list[Wrench] = []
        for index, (a, l) in self.axes:  # noqa: E741
            speed = float(bodies[index].multiplier) * qd[bodies[index].coordinate]
            w, v = w + a * speed, v + l * speed
            self.turning.append((ca.cross(w, a), ca.cross(w, l) + ca.cross(v, a)))
        self.twist = w, v

    def _per_joint(self, rows: Sequence[ca.SX]) -> ca.SX:
        """Return rows (1, columns) of the bodies as a row per joint, (n, columns)."""
        result = ca.SX(self.model.n, rows[0].shape[1])
        for (index, _), row in zip(self.axes, rows, strict=True):
            body = self.model.arm.bodies[index]
            result[body.coordinate, :] += float(body.multiplier) * row
        return result

    def momentum(self) -> ca.SX:
        """Return P, (n, 10)."""
        return self._per_joint([_projected(axis, self.twist) for _, axis in self.axes])

    def torque(self) -> ca.SX:
        """Return N, (n, 10)."""
        rows = []
        for (_, (a, l)), turning in zip(self.axes, self.turning, strict=True):  # noqa: E741
            weight = ca.horzcat(ca.dot(l, self.gravity), ca.cross(self.gravity, a).T, ca.SX(1, 6))
            rows.append(_projected(turning, self.twist) + weight)
        return self._per_joint(rows)

    def jacobian(self, point: np.ndarray) -> ca.SX:
        """Return the Jacobian of a point (3,) in root axes, (3, n)."""
        arm = constant(point[:, None])
        return self._per_joint([(self.rotation @ (l + ca.cross(a, arm))).T for _, (a, l) in self.axes]).T  # noqa: E741

    def inverse_dynamics(self, qdd: ca.SX, load: ca.SX) -> ca.SX:
        """Return the torque that moves a payload (10, 1), (n, 1): I A + V x* I V minus the weight, on each axis."""
        alpha, a_linear = ca.SX(3, 1), ca.SX(3, 1)
        for (index, (a, l)), (da, dl) in zip(self.axes, self.turning, strict=True):  # noqa: E741
            body = self.model.arm.bodies[index]
            speed, change = (float(body.multiplier) * x[body.coordinate] for x in (self.qd, qdd))
            alpha, a_linear = alpha + a * change + da * speed, a_linear + l * change + dl * speed
        mass, moment = load[0], load[1:4]
        inertia = ca.vertcat(
            ca.horzcat(load[4], load[5], load[6]),
            ca.horzcat(load[5], load[7], load[8]),
            ca.horzcat(load[6], load[8], load[9]),
        )
        w, v = self.twist
        linear, angular = mass * v + ca.cross(w, moment), inertia @ w + ca.cross(moment, v)
        accelerated = a_linear - self.gravity
        force = mass * accelerated + ca.cross(alpha, moment) + ca.cross(w, linear)
        torque = inertia @ alpha + ca.cross(moment, accelerated) + ca.cross(w, angular) + ca.cross(v, linear)
        return self._per_joint([ca.dot(a, torque) + ca.dot(l, force) for _, (a, l) in self.axes])  # noqa: E741


def _projected(axis: Wrench, twist: Wrench) -> ca.SX:
    """Return a . angular momentum + l . linear momentum per parameter, (1, 10), of a body that moves at a twist."""
    (a, l), (w, v) = axis, twist  # noqa: E741
    first = ca.cross(l, w) + ca.cross(v, a)
    products = a @ w.T
    inertia = [
        products[0, 0],
        products[0, 1] + products[1, 0],
        products[0, 2] + products[2, 0],
        products[1, 1],
    ]
    inertia += [products[1, 2] + products[2, 1], products[2, 2]]
    return ca.horzcat(ca.dot(l, v), first.T, *inertia)
