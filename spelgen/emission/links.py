"""The links of a model of rigid bodies: geometry of the arm and initial inertial parameters."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from fractions import Fraction

import numpy as np

from spelgen.arm.arm import Chain
from spelgen.arm.rational import Vector
from spelgen.emission.tuning import TUNING
from spelgen.spec import LinkSpec, Triple
from spelgen.structure.nominal import parameters_of, pseudo_inertia, reference_factor


def link_specs(arm: Chain, inertias: Sequence[Sequence[Fraction | float]]) -> tuple[LinkSpec, ...]:
    """Return the links of ``arm`` with these inertial parameters, made physically consistent if necessary.

    Args:
        arm: the arm.
        inertias: (m, m c, Ixx, Ixy, Ixz, Iyy, Iyz, Izz) of each body about the origin of its joint's frame, (10,).
    """
    # Missing masses are small relative to the heaviest link, so that they do not dominate M.
    heaviest = max(float(ten[0]) for ten in inertias)
    names = _unique([body.link for body in arm.bodies])
    specs = []
    for index, (body, ten) in enumerate(zip(arm.bodies, inertias, strict=True)):
        mass, center, inertia = _about_center(_consistent(arm, index, ten, heaviest))
        first, second, third = map(_floats, body.rotation)
        spec = LinkSpec(
            name=names[index],
            parent=body.parent,
            joint=body.coordinate,
            joint_type=body.joint_type,
            ratio=float(body.multiplier),
            offset=body.offset,
            position=_floats(body.translation),
            rotation=(first, second, third),
            mass=mass,
            center_of_mass=center,
            inertia=inertia,
        )
        specs.append(spec)
    return tuple(specs)


def _unique(names: Sequence[str]) -> list[str]:
    """Return the names, repeated ones with a number."""
    return [name if name not in names[:k] else f"{name} ({k})" for k, name in enumerate(names)]


def _consistent(
    arm: Chain, index: int, ten: Sequence[Fraction | float], heaviest: float
) -> Sequence[Fraction | float]:
    """Return physically consistent inertial parameters, (10,)."""
    # A link without mass needs one: its log-Cholesky parameters are logarithms.
    if ten[0] <= 0:
        ten = _light_ball(_length(arm, index), TUNING.default_mass * heaviest)
    factor, is_consistent = reference_factor(np.array(ten, dtype=float))
    if is_consistent and _smallest_moment(np.array(ten, dtype=float)) > TUNING.min_second_moment:
        return ten
    pseudo = factor @ factor.T
    mass, center = pseudo[3, 3], pseudo[:3, 3] / pseudo[3, 3]
    moments = pseudo[:3, :3] - mass * np.outer(center, center)
    # With smaller moments, rounding of the digits could make the body inconsistent.
    values, vectors = np.linalg.eigh(moments)
    # The principal directions are kept; only moments below the bound are raised.
    raised = np.maximum(values, 2 * TUNING.min_second_moment * values[-1])
    pseudo[:3, :3] += (vectors * (raised - values)) @ vectors.T
    return _rounded(parameters_of(pseudo))


def _smallest_moment(ten: np.ndarray) -> float:
    """Return the smallest second moment of mass about the center of mass, relative to the largest, of ten (10,)."""
    center = ten[1:4] / ten[0]
    moments = np.linalg.eigvalsh(pseudo_inertia(ten)[:3, :3] - ten[0] * np.outer(center, center))
    return float(moments[0] / moments[-1]) if moments[-1] > 0 else 0.0


def _about_center(
    ten: Sequence[Fraction | float],
) -> tuple[float, Triple, tuple[float, float, float, float, float, float]]:
    """Return mass, center of mass, and inertia about the center of mass: computed exactly, then rounded."""
    m, hx, hy, hz, *tensor = [Fraction(value) for value in ten]
    x, y, z = hx / m, hy / m, hz / m
    steiner = (y * y + z * z, -x * y, -x * z, x * x + z * z, -y * z, x * x + y * y)
    inertia = [value - m * square for value, square in zip(tensor, steiner, strict=True)]
    # rounding errors of an inertia that was made consistent
    noise = max(map(abs, inertia)) / 10 ** (TUNING.inertia_digits + 3)
    inertia = [value if abs(value) > noise else Fraction(0) for value in inertia]
    cx, cy, cz = _rounded((x, y, z))
    xx, xy, xz, yy, yz, zz = _rounded(inertia)
    return _rounded([m])[0], (cx, cy, cz), (xx, xy, xz, yy, yz, zz)


def _rounded(values: Iterable[Fraction | float]) -> list[float]:
    """Return values with the significant digits of inertial parameters."""
    digits = TUNING.inertia_digits
    return [float(f"{float(value):.{digits}g}") + 0.0 for value in values]  # no -0.0


def _light_ball(radius: float, mass: float) -> list[float]:
    moment = 0.4 * mass * radius**2
    return [mass, 0, 0, 0, moment, 0, 0, moment, 0, moment]


def _length(arm: Chain, index: int) -> float:
    """Return the distance to the next joint, at least 0.1 [m]."""
    distances = [
        float(np.linalg.norm(_floats(body.translation))) for body in arm.bodies if body.parent == index
    ]
    return max([0.1, *distances])


def _floats(values: Vector) -> Triple:
    x, y, z = map(float, values)
    return x, y, z
