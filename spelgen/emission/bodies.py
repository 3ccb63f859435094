"""The bodies of a closed-form model: the arm's geometry in numbers, and the body that training starts from."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from spelgen.arm.arm import Arm, Body
from spelgen.arm.rational import Vector
from spelgen.spec import BodySpec, Triple
from spelgen.structure.pseudo_inertia import parameters_of, reference_factor

_DIGITS = 10  # of inertial parameters: more than any URDF is known to
_LIGHT = 0.01  # of the heaviest body's mass: a body that is said to weigh nothing


def body_specs(arm: Arm, inertias: Sequence[Sequence[float]]) -> tuple[BodySpec, ...]:
    """The bodies of ``arm`` that have these ten inertial parameters each, impossible ones made possible."""
    heaviest = max(float(ten[0]) for ten in inertias)
    return tuple(
        BodySpec(
            parent=body.parent,
            joint=body.coordinate,
            kind=body.kind,
            ratio=float(body.multiplier),
            offset=body.offset,
            rotation=(_floats(body.rotation[0]), _floats(body.rotation[1]), _floats(body.rotation[2])),
            position=_floats(body.translation),
            reference=_possible(arm, index, ten, heaviest),
        )
        for index, (body, ten) in enumerate(zip(arm.bodies, inertias, strict=True))
    )


def _possible(arm: Arm, index: int, ten: Sequence[float], heaviest: float) -> tuple[float, ...]:
    values = np.array([float(f"{float(x):.{_DIGITS}g}") for x in ten])
    if values[0] <= 0:
        values = _light_ball(_reach(arm, index), _LIGHT * heaviest)
    factor, possible = reference_factor(values)
    if not possible:
        values = np.array([float(f"{x:.6g}") for x in parameters_of(factor @ factor.T)])
    return tuple(float(x) for x in values)


def _light_ball(radius: float, mass: float) -> np.ndarray:
    moment = 0.4 * mass * radius**2
    return np.array([mass, 0, 0, 0, moment, 0, 0, moment, 0, moment])


def _reach(arm: Arm, index: int) -> float:
    """The distance [m] to the next joint; 0.1 where there is none."""
    following: list[Body] = [body for body in arm.bodies if body.parent == index]
    return max([float(np.linalg.norm(_floats(body.translation))) for body in following] + [0.1])


def _floats(values: Vector) -> Triple:
    x, y, z = (float(value) for value in values)
    return x, y, z
