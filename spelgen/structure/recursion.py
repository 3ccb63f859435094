"""M(q) and V(q) of an arm by the composite-rigid-body algorithm (CRBA), over any commutative ring.

The recursion (Featherstone, *Rigid Body Dynamics Algorithms*, 2008, ch. 6) consists of additions, negations and
multiplications. The same code therefore computes with floating-point numbers (``nominal``), elements of a prime field
(``sampling``) and polynomials (``expansion``). M and V are linear in the ten inertial parameters of each body: mass m,
first moment h = m c with the centre of mass c, and inertia I about the origin of the frame of the body's joint. A joint
rotates about, or translates along, the z axis of its frame.
"""

from collections.abc import Callable, Iterator, Sequence
from fractions import Fraction
from itertools import combinations_with_replacement
from math import cos, lcm, sin, tan
from typing import Any, NamedTuple

from spelgen.arm.arm import Body, Chain

Element = Any
"""A number of the recursion: any object that supports +, - and * with such objects and with integers."""

Number = Callable[[Fraction], Element]
"""Function that converts the exact (rational) constants of an arm to the numbers of the recursion."""

Vector = tuple[Element, ...]

TENSOR = tuple(combinations_with_replacement(range(3), 2))
"""Order of the components of an inertia tensor: Ixx, Ixy, Ixz, Iyy, Iyz, Izz."""


class Position(NamedTuple):
    """The position of a coordinate q, as the recursion uses it: cosine and sine of q / d, and q itself.

    The integer d is 1 without mimic joints. With mimic joints, their angles are integer multiples of q / d plus a
    constant, so that their cosines and sines are polynomials in cos(q / d) and sin(q / d) (see ``base_denominators``).
    """

    cos: Element
    sin: Element
    value: Element


class Energies(NamedTuple):
    """The lower triangle of the mass matrix, {(row, column): element}, 0-based, and the potential energy."""

    mass: dict[tuple[int, int], Element]
    potential: Element


class _Inertia(NamedTuple):
    """Inertia of one or several rigidly connected bodies, about the origin of a frame.

    Attributes:
        mass: mass.
        moment: first moment of mass, (3,).
        tensor: inertia tensor, (6,), in the order of ``TENSOR``.
    """

    mass: Element
    moment: Vector
    tensor: tuple[Element, ...]


class _Pose(NamedTuple):
    """A rotation and a translation: the pose of a joint frame in the frame of the parent body, or a joint's motion.

    rotation: rows of the rotation matrix. Elements 0, 1 and -1 of rotation and translation are Python integers, so that
    products with them are recognized and not computed.
    """

    rotation: tuple[Vector, ...]
    translation: Vector


_Wrench = tuple[Vector, Vector]
"""A wrench: a force, and its moment about the origin of the frame."""


def triangle(n: int) -> list[tuple[int, int]]:
    """Return the indices (row, column) of the lower triangle of an n x n matrix, row after row."""
    return [(row, column) for row in range(n) for column in range(row + 1)]


def energies(
    arm: Chain, positions: Sequence[Position], inertias: Sequence[Sequence[Element]], number: Number
) -> Energies:
    """Return the mass matrix M and the potential energy V of ``arm``.

    V is zero for a mass at the origin of the root link and increases against ``arm.gravity``.

    Args:
        arm: the arm.
        positions: position of each coordinate.
        inertias: mass, first moment and inertia (10 numbers) of each body, in the order of ``Body.inertia``.
        number: conversion of the exact constants of the arm to the number type of `positions` and `inertias`.
    """
    transforms = _joint_transforms(arm, positions, number)
    poses = []
    for body in arm.bodies:
        rotation = tuple(_vector(row, number) for row in body.rotation)
        poses.append(_Pose(rotation, _vector(body.translation, number)))
    composites = [_Inertia(ten[0], tuple(ten[1:4]), tuple(ten[4:10])) for ten in inertias]
    total = _Inertia(0, (0, 0, 0), (0,) * 6)
    mass = dict.fromkeys(triangle(len(arm.coordinates)), 0)
    # Parents precede children in `arm.bodies`. In reverse order, all children are added to the composite inertia of a
    # body before its column of M is computed.
    for index, body in reversed(list(enumerate(arm.bodies))):
        for ancestor, entry in _column(arm, poses, transforms, index, composites[index]):
            first, second = body.coordinate, ancestor.coordinate
            # The velocity of a mimic joint is `multiplier` times the velocity of its leader.
            multiplier = body.multiplier * ancestor.multiplier
            if multiplier != 1:
                entry = number(multiplier) * entry
            # Two different bodies i, j that move with the same coordinate contribute twice to its diagonal entry of M:
            # by (i, j) and (j, i).
            if first == second and body is not ancestor:
                entry = entry + entry
            key = max(first, second), min(first, second)
            mass[key] = mass[key] + entry
        moved = _posed_inertia(poses[index], _inertia_at_zero(transforms[index], composites[index]))
        if body.parent < 0:
            total = _sum(total, moved)
        else:
            composites[body.parent] = _sum(composites[body.parent], moved)
    # The potential energy is V = -g . sum_b m_b c_b, with the gravity g, and masses m_b and centers of mass c_b of the
    # bodies in the frame of the root link. The sum is `total.moment`, the first moment of all bodies together.
    gravity = _vector(arm.gravity, number)
    return Energies(mass, -_dot(gravity, total.moment))


def coefficients(
    arm: Chain, positions: Sequence[Position], units: Sequence[Element], number: Number
) -> list[Element]:
    """Return the coefficients of the inertial parameters in each entry of the mass matrix M and in the potential V.

    M and V are linear in the 10 B inertial parameters of B bodies. If unit vector k, (10 B,), replaces the inertial
    parameter k in ``energies``, each entry of the result is a vector: its coefficients, in place of its value.

    Args:
        arm: the arm.
        positions: cosine, sine and value of each coordinate.
        units: the 10 B unit vectors, (10 B,) each, in place of the inertial parameters.
        number: conversion of the exact constants of the arm to the number type of `positions` and `units`.

    Returns:
        n(n+1)/2 + 1 vectors, (10 B,) each: the entries of the lower triangle of M, row after row, then V.
    """
    inertias = [units[10 * body : 10 * body + 10] for body in range(len(arm.bodies))]
    result = energies(arm, positions, inertias, number)
    return [*result.mass.values(), result.potential]


def _joint_transforms(arm: Chain, positions: Sequence[Position], number: Number) -> list[_Pose]:
    """Return the transform of each body in its joint's frame due to ``positions``: rotation about z or translation.

    number: conversion of the exact constants of the arm to the number type of `positions`.
    """
    bases = base_denominators(arm)
    transforms = []
    for body in arm.bodies:
        position = positions[body.coordinate]
        if body.joint_type == "prismatic":
            slide = position.value
            if body.multiplier != 1:
                slide = number(body.multiplier) * slide
            if body.offset:
                slide = slide + number(Fraction(str(body.offset)))
            transforms.append(_Pose(((1, 0, 0), (0, 1, 0), (0, 0, 1)), (0, 0, slide)))
        else:
            factor = int(body.multiplier * bases[body.coordinate])
            c, s = _multiple_angle(position.cos, position.sin, factor)
            if body.offset:
                c0, s0 = map(number, circle_point(body.offset))
                c, s = c0 * c - s0 * s, s0 * c + c0 * s
            transforms.append(_Pose(((c, -s, 0), (s, c, 0), (0, 0, 1)), (0, 0, 0)))
    return transforms


def circle_point(angle: float) -> tuple[Fraction, Fraction]:
    """Return rational cosine and sine of an angle [rad] with cos^2 + sin^2 = 1 exactly and an error of 1e-13."""
    # tan(angle / 2) has a pole at pi. Cosine and sine of all multiples of a right angle are therefore rounded, to -1, 0
    # or 1.
    if abs(cos(angle)) < 1e-12 or abs(sin(angle)) < 1e-12:
        return Fraction(round(cos(angle))), Fraction(round(sin(angle)))
    t = Fraction(tan(angle / 2)).limit_denominator(10**7)
    return (1 - t * t) / (1 + t * t), 2 * t / (1 + t * t)


def base_denominators(arm: Chain) -> list[int]:
    """Return for each coordinate q the smallest integer d, so that joint angles are integer multiples of q / d.

    The angle of each revolute joint that q moves, including mimic joints, is an integer multiple of q / d plus a
    constant: its cosine and sine are polynomials in cos(q / d) and sin(q / d).
    """
    denominators = [1] * len(arm.coordinates)
    for body in arm.bodies:
        if body.joint_type == "revolute":
            index = body.coordinate
            denominators[index] = lcm(denominators[index], body.multiplier.denominator)
    return denominators


def _multiple_angle(c: Element, s: Element, factor: int) -> tuple[Element, Element]:
    """Return cosine and sine of ``factor`` times an angle with the cosine ``c`` and the sine ``s``."""
    result = (1, 0)
    # The angle of `result` is doubled for each bit of `factor`, and increased by the given angle for each bit that is
    # 1. This takes fewer products than repeated addition: factors are as large as 20.
    for bit in bin(abs(factor))[2:]:
        x, y = result
        # The square of the complex number x + i y has twice its angle: (x + i y)^2 = x^2 - y^2 + 2 i x y.
        result = (x * x - y * y, 2 * (x * y))
        if bit == "1":
            x, y = result
            result = (x * c - y * s, y * c + x * s)
    if factor < 0:
        return result[0], -result[1]
    return result


def _column(
    arm: Chain, poses: Sequence[_Pose], transforms: Sequence[_Pose], index: int, inertia: _Inertia
) -> Iterator[tuple[Body, Element]]:
    """Yield the entries of M in the column of a body's joint, as pairs (body of the row, entry).

    The first entry is the diagonal one, in the row of the body itself. The next entries are in the rows of its
    ancestors, from the parent to the root. M is the mass matrix of all joints, before mimic joints are eliminated.

    Args:
        arm: the arm.
        poses: pose of each joint frame in the frame of the parent body.
        transforms: transform of each body in its joint's frame due to the joint's position.
        index: index of the body in `arm.bodies`.
        inertia: composite inertia of the body and all its descendants.
    """
    body = arm.bodies[index]
    # The composite body has the mass m, first moment h and inertia tensor I about the joint's origin. `wrench` (force,
    # moment) gives it a unit acceleration about or along the joint axis z: (z x h, I z) if revolute, (m z, h x z) if
    # prismatic. The component of the wrench along the joint axis of an ancestor is the entry of M (Featherstone, table
    # 6.2).
    (hx, hy, _), tensor = inertia.moment, inertia.tensor
    wrench = (-hy, hx, 0), (tensor[2], tensor[4], tensor[5])
    if body.joint_type == "prismatic":
        wrench = (0, 0, inertia.mass), (hy, -hx, 0)
    while True:
        force, moment = wrench
        yield body, moment[2] if body.joint_type == "revolute" else force[2]
        if body.parent < 0:
            return
        wrench = _posed_wrench(poses[index], _posed_wrench(transforms[index], wrench))
        index, body = body.parent, arm.bodies[body.parent]


def _sum(a: _Inertia, b: _Inertia) -> _Inertia:
    moment = tuple(x + y for x, y in zip(a.moment, b.moment, strict=True))
    return _Inertia(a.mass + b.mass, moment, tuple(x + y for x, y in zip(a.tensor, b.tensor, strict=True)))


def _inertia_at_zero(transform: _Pose, inertia: _Inertia) -> _Inertia:
    """Return the inertia of a body that its joint has displaced, expressed in the joint frame at q = 0, which is fixed.

    inertia: inertia of the body in the frame that moves with it. transform: pose of this moving frame in the fixed
    frame, a rotation about z or a translation along z.
    """
    s, c, _ = transform.rotation[1]
    # An integer c indicates a prismatic joint: its rotation is the identity, with integers, so no rotation is needed.
    # The cosine of a revolute joint is never an integer, but a number or polynomial.
    if isinstance(c, int):
        return _translated(transform.translation, inertia)
    hx, hy, hz = inertia.moment
    xx, xy, xz, yy, yz, zz = inertia.tensor
    # sin^2 is replaced by 1 - cos^2: otherwise the polynomials would contain both squares, and need a reduction.
    cc, cs, difference = c * c, c * s, xx - yy
    # The tensor becomes R I R^T for a rotation R about z. Ixx + Iyy is invariant, so Iyy needs no products.
    turned_xx = yy + cc * difference - 2 * (cs * xy)
    turned_xy = cs * difference + 2 * (cc * xy) - xy
    tensor = (turned_xx, turned_xy, c * xz - s * yz, xx + yy - turned_xx, s * xz + c * yz, zz)
    return _Inertia(inertia.mass, (c * hx - s * hy, s * hx + c * hy, hz), tensor)


def _posed_inertia(pose: _Pose, inertia: _Inertia) -> _Inertia:
    xx, xy, xz, yy, yz, zz = inertia.tensor
    columns = ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz))
    half = [[_dot(row, column) for column in columns] for row in pose.rotation]
    tensor = tuple(_dot(pose.rotation[j], half[i]) for i, j in TENSOR)
    return _translated(pose.translation, _Inertia(inertia.mass, _turned(pose, inertia.moment), tensor))


def _posed_wrench(pose: _Pose, wrench: _Wrench) -> _Wrench:
    force, moment = (_turned(pose, vector) for vector in wrench)
    (x, y, z), (fx, fy, fz), (mx, my, mz) = pose.translation, force, moment
    return force, (mx + y * fz - z * fy, my - x * fz + z * fx, mz + x * fy - y * fx)


def _turned(pose: _Pose, vector: Vector) -> Vector:
    return tuple(_dot(row, vector) for row in pose.rotation)


def _translated(offset: Vector, inertia: _Inertia) -> _Inertia:
    """Return the inertia about an origin that is displaced by -``offset``, by the parallel-axis theorem.

    With the mass m and p = ``offset``, the first moment h changes to h + m p.
    """
    (x, y, z), mass, (hx, hy, hz) = offset, inertia.mass, inertia.moment
    xx, xy, xz, yy, yz, zz = inertia.tensor
    moment = (hx + x * mass, hy + y * mass, hz + z * mass)
    # All points of the body have the position r + p about the new origin, with r about the old one and p = `offset`.
    # The inertia tensor I becomes I + (p.k) 1 - (p k^T + k p^T) / 2, with k = 2 h + m p, the mass m and the first
    # moment h about the old origin.
    dx, dy, dz = (p * (old + new) for p, old, new in zip(offset, inertia.moment, moment, strict=True))
    xy = xy - x * hy - y * hx - x * y * mass
    xz = xz - x * hz - z * hx - x * z * mass
    yz = yz - y * hz - z * hy - y * z * mass
    return _Inertia(mass, moment, (xx + dy + dz, xy, xz, yy + dx + dz, yz, zz + dx + dy))


def _vector(values: Sequence[Fraction], number: Number) -> Vector:
    # The elements 0, 1 and -1 of a vector become Python integers: products with 0 and 1 then need no multiplication.
    return tuple(int(x) if x in (0, 1, -1) else number(x) for x in values)


def _dot(row: Vector, vector: Sequence[Element]) -> Element:
    return sum(x * y for x, y in zip(row, vector, strict=True) if not (isinstance(x, int) and x == 0))
