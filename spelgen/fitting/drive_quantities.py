"""Drive constants with 95 % intervals: armature, friction (a straight line over velocity), torque offset, gain."""

from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import numpy as np
import torch
from torch import Tensor

from spelgen.dynamics.parameters import friction_factor
from spelgen.dynamics.protocol import motors_of
from spelgen.emission.assemble import ArmModel
from spelgen.runtime.motors import MotorInputs

ModelFunction: TypeAlias = Callable[[ArmModel], Tensor]
"""A function that computes values from the parameters of a model."""


class DriveQuantity(NamedTuple):
    """A constant of drives that has one value per joint.

    unit: format string into which the units of the joint's type (`UNITS`) are inserted, for example "{0.torque}".
    positive: True if all values are positive. joints: indices of the joints that have this constant.
    """

    name: str
    unit: str
    positive: bool
    joints: tuple[int, ...]


TORQUE_UNITS = {
    "armature": "{0.inertia}",
    "viscous": "{0.torque} s/{0.position}",
    "coulomb": "{0.torque}",
    "offset": "{0.torque}",
    "gain": "",
}
"""Unit of each constant of drives whose input is a torque, as a format string for `UNITS`."""


def torque_drive_quantities(model: ArmModel) -> tuple[list[DriveQuantity], ModelFunction]:
    """Return the constants of drives whose input is a torque, and the function that returns their values.

    The constants are armature, viscous friction, Coulomb friction, torque offset and, if motor gains are trained, gain.
    The function returns (4, n) for a model, or (5, n) with gains. Viscous and Coulomb friction approximate the friction
    by least squares up to the typical speed of each drive.
    """
    line = friction_line(model)
    gains = model.inputs.gain_rows.tolist() if isinstance(model.inputs, MotorInputs) else []
    quantities = [
        DriveQuantity(
            name, unit, name not in ("viscous", "offset"), tuple(gains if name == "gain" else range(model.n))
        )
        for name, unit in TORQUE_UNITS.items()
        if gains or name != "gain"
    ]

    def constants(model: ArmModel) -> Tensor:
        """Return the rows armature, viscous, coulomb, offset and, if trained, gain, (4 or 5, n); see `TORQUE_UNITS`."""
        rows = [model.armature, *line(model), model.torque_offset]
        if gains and isinstance(model.inputs, MotorInputs):
            rows.append(model.inputs.gains().sum(dim=1))
        return torch.stack(rows)

    return quantities, constants


def friction_line(model: ArmModel) -> ModelFunction:
    """Return a function: model -> its viscous and Coulomb friction coefficients, (2, n) [Nm s/rad, N s/m; Nm, N].

    The coefficients are the slope and the intercept of a straight line, fitted by least squares to the friction torque
    at speeds up to the typical speed of each drive (`friction.speed`). The friction torque is averaged over random
    positions. The friction torque depends on the gravity load and on the friction factor of residual terms. Load and
    factor are computed once, for the argument ``model``; the returned function uses them for every model.
    """
    rng, joints = np.random.default_rng(0), model.spec.joints
    deviations = rng.uniform(-1.0, 1.0, (32, model.n)) * [x.half_range for x in joints]
    q = torch.from_numpy([x.center for x in joints] + deviations)
    with torch.no_grad():
        # The load of each drive is the gravity torque in the drive's coordinates, at P = 32 random positions, (P, n).
        load = model.gravity(q) @ torch.linalg.inv(motors_of(model))
        factor = friction_factor(model, q)
    # The line is fitted to the friction torque at these 25 speeds, which are divided by the typical speed. Most of them
    # are low, since the intercept of the line (Coulomb friction) depends on the friction at low speeds, including the
    # Stribeck effect.
    speeds = np.geomspace(0.02, 1.0, 25)
    line = torch.from_numpy(np.linalg.pinv(np.stack([speeds, np.ones_like(speeds)], axis=-1)))

    def line_of(model: ArmModel) -> Tensor:
        """Return viscous [Nm s/rad, N s/m] and Coulomb [Nm, N] friction coefficients of `model`, (2, n)."""
        friction = model.friction
        speed = torch.from_numpy(speeds)[:, None] * friction.speed
        slope, intercept = line @ (factor * friction.prepare().torque(speed[:, None], load)).mean(dim=1)
        return torch.stack([slope / friction.speed, intercept])

    return line_of
