"""Exact rotations and vectors over the rationals, and how a measured angle becomes one of them."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from math import atan2, cos, lcm, pi, sin, tan

import numpy as np

Vector = tuple[Fraction, Fraction, Fraction]
Matrix = tuple[Vector, Vector, Vector]
Tensor = tuple[Fraction, Fraction, Fraction, Fraction, Fraction, Fraction]

_ZERO, _ONE = Fraction(0), Fraction(1)
IDENTITY: Matrix = ((_ONE, _ZERO, _ZERO), (_ZERO, _ONE, _ZERO), (_ZERO, _ZERO, _ONE))
ZERO: Vector = (_ZERO, _ZERO, _ZERO)

# Rotations that take +z to +-x, +-y, +-z, by (index, sign); their columns are the joint frame's x, y, z.
_ALIGNMENTS = {
    (0, 1): ((0, 0, 1), (1, 0, 0), (0, 1, 0)),
    (0, -1): ((0, 0, -1), (0, 1, 0), (1, 0, 0)),
    (1, 1): ((0, 1, 0), (0, 0, 1), (1, 0, 0)),
    (1, -1): ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
    (2, 1): ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    (2, -1): ((1, 0, 0), (0, -1, 0), (0, 0, -1)),
}
_FINE_STEPS = (pi / 12, pi / 8, pi / 5)
_FINE_TOLERANCE = 2e-5
_REACH = 1e-11
_NOISE = 1e-12
_BOUNDS = (10**7, 10**10, 10**13)
_EDGE = 0.7  # rad, just below pi/4
_MAX_BITS = 4096


def exact(value: float) -> Fraction:
    """The decimal a float was written as: 0.1 is 1/10."""
    return Fraction(repr(value))


def bounded(value: Fraction) -> Fraction:
    """The number itself, or the nearest float to one of thousands of digits.

    Such a number is no exact value but the trace of dozens of rounded rotations in a row; kept, it would make
    a hostile file take hours.
    """
    return value if value.denominator.bit_length() <= _MAX_BITS else Fraction(float(value))


def rounded_angle(angle: float, tolerance: float) -> float:
    """The multiple of pi/2 within ``tolerance`` [rad], else of pi/12, pi/8, pi/5 within 2e-5, else itself.

    A tolerance of 0 takes every angle as it is written.
    """
    if tolerance == 0.0:
        return angle
    for step, reach in ((pi / 2, tolerance), *((step, _FINE_TOLERANCE) for step in _FINE_STEPS)):
        nearest = round(angle / step) * step
        if abs(nearest - angle) <= reach:
            return nearest
    return angle


def rotation_from_rpy(rpy: Sequence[float]) -> np.ndarray:
    """Rz(yaw) Ry(pitch) Rx(roll) of URDF's fixed-axis angles [rad], (3, 3) float64."""
    (cr, sr), (cp, sp), (cy, sy) = ((cos(angle), sin(angle)) for angle in rpy)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def rotation_about(axis: np.ndarray, angle: float) -> np.ndarray:
    """Rotation by ``angle`` [rad] about the unit vector ``axis``, (3, 3) float64 (Rodrigues' formula)."""
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + sin(angle) * cross + (1.0 - cos(angle)) * (cross @ cross)


def alignment(axis: np.ndarray) -> np.ndarray:
    """A rotation (3, 3) that takes +z to the unit vector ``axis``; a signed permutation for +-x, +-y, +-z.

    Other axes are reached from the nearest coordinate axis by the smallest rotation, which keeps what zeros
    it can.
    """
    index = int(np.argmax(np.abs(axis)))
    sign = 1 if axis[index] > 0 else -1
    start = np.zeros(3)
    start[index] = sign
    cross = np.cross(start, axis)
    skew = np.array([[0.0, -cross[2], cross[1]], [cross[2], 0.0, -cross[0]], [-cross[1], cross[0], 0.0]])
    smallest = np.eye(3) + skew + skew @ skew / (1.0 + float(start @ axis))
    return smallest @ np.array(_ALIGNMENTS[index, sign], dtype=float)


def exact_rotation(rotation: np.ndarray) -> Matrix:
    """A rational rotation within 1e-11 of a float64 one, exactly orthogonal, with zeros where it has zeros.

    The unit quaternion is divided by its largest component and each ratio replaced by a nearby fraction; the
    rotation of an unnormalised rational quaternion is rational (Euler-Rodrigues). That may miss a zero which
    the ratios only make together; one turn before and one behind a signed permutation then keep it.
    """
    ratios = _quaternion_ratios(rotation)
    for bound in _BOUNDS:
        candidate = _rotation_of(*(Fraction(ratio).limit_denominator(bound) for ratio in ratios))
        if np.abs(np.array(candidate, dtype=float) - rotation).max() < _REACH:
            break
    if not lost_zeros(candidate, rotation):
        return candidate
    row, column = np.argwhere(np.abs(rotation) < _NOISE)[0].tolist()
    return _rotation_with_zero(rotation, row, column)


def lost_zeros(candidate: Matrix, rotation: np.ndarray) -> int:
    """How many zeros of a float64 rotation are none in the rational ``candidate``."""
    return sum(
        bool(element) and abs(value) < _NOISE
        for elements, values in zip(candidate, rotation.tolist(), strict=True)
        for element, value in zip(elements, values, strict=True)
    )


def _rotation_with_zero(r: np.ndarray, i: int, j: int) -> Matrix:
    """The rational rotation near r, of which element (i, j) is zero: a turn about axis i, a signed
    permutation, and a turn about axis j, so that the other zeros are those of the turns.
    """
    before = _turn(i, r[(i + 1) % 3, j], r[(i + 2) % 3, j])
    behind = _turn(j, r[i, (j + 1) % 3], -r[i, (j + 2) % 3])
    between = np.rint(np.array(before, dtype=float).T @ r @ np.array(behind, dtype=float).T).astype(int)
    x, y, z = ((Fraction(a), Fraction(b), Fraction(c)) for a, b, c in between.tolist())
    return product(product(before, (x, y, z)), behind)


def _turn(axis: int, cosine: float, sine: float) -> Matrix:
    """The rational rotation about a coordinate axis by the angle of this cosine and sine."""
    # reduced to one eighth, so that 45 and 135 degrees are a right angle apart; no usual angle is on an edge
    quarter, angle = divmod(atan2(sine, cosine) + _EDGE, pi / 2)
    tangent = tan((angle - _EDGE) / 2)
    for bound in _BOUNDS:
        t = Fraction(0) if abs(tangent) < _NOISE else Fraction(tangent).limit_denominator(bound)
        if abs(float(t) - tangent) < _REACH / 4:
            break
    c, s = (1 - t * t) / (1 + t * t), 2 * t / (1 + t * t)
    for _ in range(int(quarter) % 4):
        c, s = -s, c
    turned = [[Fraction(int(row == column)) for column in range(3)] for row in range(3)]
    first, second = (axis + 1) % 3, (axis + 2) % 3
    turned[first][first], turned[first][second] = c, -s
    turned[second][first], turned[second][second] = s, c
    x, y, z = ((a, b, c) for a, b, c in turned)
    return x, y, z


def _quaternion_ratios(r: np.ndarray) -> list[float]:
    """The quaternion (w, x, y, z) over its largest component, noise removed (Shepperd's method)."""
    trace = float(np.trace(r))
    squares = np.array([trace, r[0, 0], r[1, 1], r[2, 2]])
    largest = int(np.argmax(squares))
    if largest == 0:
        parts = np.array([1.0 + trace, r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]])
    else:
        i = largest - 1
        j, k = (i + 1) % 3, (i + 2) % 3
        parts = np.zeros(4)
        parts[0] = r[k, j] - r[j, k]
        parts[1 + i] = 1.0 + r[i, i] - r[j, j] - r[k, k]
        parts[1 + j] = r[j, i] + r[i, j]
        parts[1 + k] = r[k, i] + r[i, k]
    ratios = parts / parts[np.argmax(np.abs(parts))]
    return [0.0 if abs(ratio) < _NOISE else float(ratio) for ratio in ratios]


def _rotation_of(*quaternion: Fraction) -> Matrix:
    # over one denominator, whole numbers do: fractions are costly
    common = lcm(*(part.denominator for part in quaternion))
    w, x, y, z = (part.numerator * (common // part.denominator) for part in quaternion)
    norm = w * w + x * x + y * y + z * z
    rows = (
        (norm - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), norm - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), norm - 2 * (x * x + y * y)),
    )
    first, second, third = ((Fraction(a, norm), Fraction(b, norm), Fraction(c, norm)) for a, b, c in rows)
    return first, second, third


def transposed(a: Matrix) -> Matrix:
    """The transpose, which is a rotation's inverse."""
    return (a[0][0], a[1][0], a[2][0]), (a[0][1], a[1][1], a[2][1]), (a[0][2], a[1][2], a[2][2])


def product(a: Matrix, b: Matrix) -> Matrix:
    """The matrix product a b."""
    if a == IDENTITY:
        return b
    x, y, z = (rotated(a, column) for column in transposed(b))
    return transposed((x, y, z))


def rotated(a: Matrix, vector: Vector) -> Vector:
    """The product of a matrix and a vector."""
    x, y, z = (_dot(row, vector) for row in a)
    return x, y, z


def summed(a: Vector, b: Vector) -> Vector:
    """The sum of two vectors."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


def rotated_tensor(a: Matrix, tensor: Tensor) -> Tensor:
    """a T a^T of a symmetric tensor (xx, xy, xz, yy, yz, zz)."""
    if a == IDENTITY:
        return tensor
    xx, xy, xz, yy, yz, zz = tensor
    half = product(a, ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz)))
    full = product(half, transposed(a))
    return full[0][0], full[0][1], full[0][2], full[1][1], full[1][2], full[2][2]


def _dot(a: Vector, b: Vector) -> Fraction:
    # zeros are common here, and skipping them is what makes exact arithmetic cheap
    return sum((x * y for x, y in zip(a, b, strict=True) if x and y), start=_ZERO)
