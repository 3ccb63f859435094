"""The bodies of a closed-form model: the arm's geometry in numbers, and the body that training starts from."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from decimal import Decimal

import numpy as np

from spelgen.arm.arm import Arm
from spelgen.arm.rational import Vector
from spelgen.spec import BodySpec, Triple
from spelgen.structure.pseudo_inertia import parameters_of, reference_factor

_DIGITS = 10  # of inertial parameters: more than any URDF is known to
_LIGHT = 0.01  # of the heaviest body's mass: a body that is said to weigh nothing


def body_specs(arm: Arm, inertias: Sequence[Sequence[float]]) -> tuple[BodySpec, ...]:
    """The bodies of ``arm`` that have these ten inertial parameters each, impossible ones made possible."""
    heaviest = max(float(ten[0]) for ten in inertias)
    specs = []
    for index, (body, ten) in enumerate(zip(arm.bodies, inertias, strict=True)):
        position = _floats(body.translation)
        placement = tuple((*_floats(row), x) for row, x in zip(body.rotation, position, strict=True))
        spec = BodySpec(
            parent=body.parent,
            joint=body.coordinate,
            kind=body.kind,
            ratio=float(body.multiplier),
            offset=body.offset,
            placement=placement,
            pseudo_inertia=_upper_triangle(_possible(arm, index, ten, heaviest)),
        )
        specs.append(spec)
    return tuple(specs)


def _possible(arm: Arm, index: int, ten: Sequence[float], heaviest: float) -> tuple[float, ...]:
    values = _rounded(ten, _DIGITS)
    if values[0] <= 0:
        values = _light_ball(_reach(arm, index), _LIGHT * heaviest)
    factor, possible = reference_factor(values)
    if not possible:
        values = _rounded(parameters_of(factor @ factor.T), 6)
    return tuple(values.tolist())


def _upper_triangle(ten: Iterable[float]) -> tuple[float, ...]:
    """Return the upper triangle of a pseudo-inertia, row by row, without an error of rounding."""
    m, x, y, z, xx, xy, xz, yy, yz, zz = (Decimal(repr(value)) for value in ten)
    half = (xx + yy + zz) / 2
    triangle = (half - xx, -xy, -xz, x, half - yy, -yz, y, half - zz, z, m)
    return tuple(float(value) + 0.0 for value in triangle)  # no -0.0


def _rounded(values: Iterable[float], digits: int) -> np.ndarray:
    return np.array([float(f"{float(value):.{digits}g}") for value in values])


def _light_ball(radius: float, mass: float) -> np.ndarray:
    moment = 0.4 * mass * radius**2
    return np.array([mass, 0, 0, 0, moment, 0, 0, moment, 0, moment])


def _reach(arm: Arm, index: int) -> float:
    """The distance [m] to the next joint; 0.1 where there is none."""
    reach = 0.1
    for body in arm.bodies:
        if body.parent == index:
            reach = max(reach, float(np.linalg.norm(_floats(body.translation))))
    return reach


def _floats(values: Vector) -> Triple:
    x, y, z = map(float, values)
    return x, y, z
