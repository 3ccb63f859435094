"""Exact rotations and vectors over the rationals, and how a measured angle becomes one of them."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from math import atan2, cos, lcm, pi, sin, tan

import numpy as np

from spelgen.settings.tuning.structure import GeometryTuning

Vector = tuple[Fraction, Fraction, Fraction]
Matrix = tuple[Vector, Vector, Vector]
Tensor = tuple[Fraction, Fraction, Fraction, Fraction, Fraction, Fraction]

TUNING = GeometryTuning()

_ZERO = Fraction(0)
_ONE = Fraction(1)
IDENTITY: Matrix = ((_ONE, _ZERO, _ZERO), (_ZERO, _ONE, _ZERO), (_ZERO, _ZERO, _ONE))
ZERO: Vector = (_ZERO, _ZERO, _ZERO)


def exact(value: float) -> Fraction:
    """Return the decimal a float was written as: 0.1 is 1/10."""
    return Fraction(repr(value))


def bounded(value: Fraction) -> Fraction:
    """Return the number itself, or the nearest float to one of thousands of digits.

    Such a number is no exact value but the trace of dozens of rounded rotations in a row; kept, it would make
    a hostile file take hours.
    """
    if value.denominator.bit_length() <= TUNING.most_bits:
        return value
    return Fraction(float(value))


def rounded_angle(angle: float, tolerance: float) -> float:
    """Return the multiple of pi/2 within ``tolerance`` [rad], else of a finer step within 2e-5, else the angle.

    A tolerance of 0 takes every angle as it is written.
    """
    if tolerance == 0.0:
        return angle
    nearest = round(angle / (pi / 2)) * (pi / 2)
    if abs(nearest - angle) <= tolerance:
        return nearest
    for divisor in TUNING.fine_divisors:
        step = pi / divisor
        nearest = round(angle / step) * step
        if abs(nearest - angle) <= TUNING.fine_tolerance:
            return nearest
    return angle


def rotation_from_rpy(rpy: Sequence[float]) -> np.ndarray:
    """Return Rz(yaw) Ry(pitch) Rx(roll) of URDF's fixed-axis angles [rad], (3, 3) float64."""
    # written out: SciPy's Rotation takes as long for one origin as all else for a joint
    (cr, cp, cy), (sr, sp, sy) = map(cos, rpy), map(sin, rpy)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def rotation_about(axis: np.ndarray, angle: float) -> np.ndarray:
    """Return the rotation by ``angle`` [rad] about the unit vector ``axis``, (3, 3) float64 (Rodrigues)."""
    cross = np.cross(np.eye(3), axis)
    rotation: np.ndarray = np.eye(3) + sin(angle) * cross + (1.0 - cos(angle)) * (cross @ cross)
    return rotation


def alignment(axis: np.ndarray) -> np.ndarray:
    """Return a rotation (3, 3) that takes +z to the unit vector ``axis``; a signed permutation for +-x, +-y, +-z.

    Other axes are reached from the nearest coordinate axis by the smallest rotation, which keeps what zeros
    it can.
    """
    index = int(np.argmax(np.abs(axis)))
    sign = 1.0 if axis[index] > 0 else -1.0
    start = np.zeros(3)
    start[index] = sign
    cross = np.cross(start, axis)
    skew = np.cross(np.eye(3), cross)
    smallest = np.eye(3) + skew + skew @ skew / (1.0 + float(start @ axis))
    turned: np.ndarray = smallest @ _coordinate_alignment(index, sign)
    return turned


def _coordinate_alignment(index: int, sign: float) -> np.ndarray:
    """Return a signed permutation (3, 3) that takes +z to the coordinate axis ``index``, or against it."""
    following, last = np.eye(3)[(index + 1) % 3], np.eye(3)[(index + 2) % 3]
    axis = sign * np.eye(3)[index]
    if sign > 0:
        return np.stack([following, last, axis], axis=1)
    if index == 2:
        # half a turn about x: modules written before count on the x that -z axes keep
        return np.stack([following, -last, axis], axis=1)
    return np.stack([last, following, axis], axis=1)


def exact_rotation(rotation: np.ndarray) -> Matrix:
    """Return a rational rotation within 1e-11 of a float64 one, exactly orthogonal, with zeros where it has zeros.

    The unit quaternion is divided by its largest component and each ratio replaced by a nearby fraction; the
    rotation of an unnormalised rational quaternion is rational (Euler-Rodrigues). That may miss a zero which
    the ratios only make together; one turn before and one behind a signed permutation then keep it.
    """
    ratios = _quaternion_ratios(rotation)
    candidate = IDENTITY
    # the shortest fractions that are near enough keep exact arithmetic fast
    for bound in TUNING.denominators:
        w, x, y, z = (Fraction(ratio).limit_denominator(bound) for ratio in ratios)
        candidate = _rotation_of(w, x, y, z)
        if np.abs(np.array(candidate, dtype=float) - rotation).max() < TUNING.rotation_error:
            break
    if not lost_zeros(candidate, rotation):
        return candidate
    row, column = np.argwhere(np.abs(rotation) < TUNING.zero_noise)[0].tolist()
    return _rotation_with_zero(rotation, row, column)


def _quaternion_ratios(rotation: np.ndarray) -> list[float]:
    """Return the quaternion (w, x, y, z) over its largest component, noise removed (Shepperd's method).

    SciPy's Rotation finds the same, at 0.2 ms a call for its checks: as long as all else here.
    """
    trace = float(np.trace(rotation))
    squares = np.empty((4, 4))  # 4 q q^T
    squares[0, 0] = 1.0 + trace
    squares[1:, 1:] = rotation + rotation.T + (1.0 - trace) * np.eye(3)
    antisymmetric = rotation - rotation.T
    squares[0, 1:] = squares[1:, 0] = antisymmetric[2, 1], antisymmetric[0, 2], antisymmetric[1, 0]
    largest = int(np.argmax(np.diag(squares)))
    ratios = squares[largest] / squares[largest, largest]
    ratios[np.abs(ratios) < TUNING.zero_noise] = 0.0
    components: list[float] = ratios.tolist()
    return components


def lost_zeros(candidate: Matrix, rotation: np.ndarray) -> int:
    """Return how many zeros of a float64 rotation are none in the rational ``candidate``."""
    lost = 0
    for row, column in np.argwhere(np.abs(rotation) < TUNING.zero_noise).tolist():
        if candidate[row][column]:
            lost += 1
    return lost


def _rotation_with_zero(rotation: np.ndarray, row: int, column: int) -> Matrix:
    """Return the rational rotation near a float64 one of which this element is zero: a turn about axis ``row``,
    a signed permutation, and a turn about axis ``column``, so that the other zeros are those of the turns.
    """
    first = _turn(row, rotation[(row + 1) % 3, column], rotation[(row + 2) % 3, column])
    last = _turn(column, rotation[row, (column + 1) % 3], -rotation[row, (column + 2) % 3])
    between = np.array(first, dtype=float).T @ rotation @ np.array(last, dtype=float).T
    x, y, z = ((Fraction(a), Fraction(b), Fraction(c)) for a, b, c in np.rint(between).astype(int).tolist())
    return product(product(first, (x, y, z)), last)


def _turn(axis: int, cosine: float, sine: float) -> Matrix:
    """Return the rational rotation about a coordinate axis by the angle of this cosine and sine."""
    # reduced to one eighth, so that 45 and 135 degrees are a right angle apart; no usual angle is on an edge
    quarter, angle = divmod(atan2(sine, cosine) + TUNING.eighth, pi / 2)
    tangent = tan((angle - TUNING.eighth) / 2)
    t = _ZERO
    if abs(tangent) >= TUNING.zero_noise:
        for bound in TUNING.denominators:
            t = Fraction(tangent).limit_denominator(bound)
            # an angle is off by twice what its half-angle tangent is, and two turns share the error
            if abs(float(t) - tangent) < TUNING.rotation_error / 4:
                break
    norm = 1 + t * t
    c, s = (1 - t * t) / norm, 2 * t / norm
    for _ in range(int(quarter) % 4):
        c, s = -s, c
    return turn_about(axis, c, s)


def turn_about(axis: int, cosine: Fraction, sine: Fraction) -> Matrix:
    """Return the rotation about the coordinate axis 0, 1 or 2 by the angle of this cosine and sine."""
    rows = list(map(list, IDENTITY))
    first, second = (axis + 1) % 3, (axis + 2) % 3
    rows[first][first] = rows[second][second] = cosine
    rows[first][second] = -sine
    rows[second][first] = sine
    x, y, z = ((a, b, c) for a, b, c in rows)
    return x, y, z


def _rotation_of(w: Fraction, x: Fraction, y: Fraction, z: Fraction) -> Matrix:
    """Return the rotation of a quaternion of any length (Euler-Rodrigues)."""
    # over one denominator, whole numbers do: fractions are costly
    common = lcm(w.denominator, x.denominator, y.denominator, z.denominator)
    v = [int(component * common) for component in (x, y, z)]
    scalar = int(w * common)
    norm = scalar * scalar + v[0] * v[0] + v[1] * v[1] + v[2] * v[2]
    # R = (w^2 - v.v) 1 + 2 v v^T + 2 w [v]x, over the norm
    rows = [[2 * a * b for b in v] for a in v]
    for axis in range(3):
        following, last = (axis + 1) % 3, (axis + 2) % 3
        rows[axis][axis] += 2 * scalar * scalar - norm
        rows[last][following] += 2 * scalar * v[axis]
        rows[following][last] -= 2 * scalar * v[axis]
    first, second, third = ((Fraction(a, norm), Fraction(b, norm), Fraction(c, norm)) for a, b, c in rows)
    return first, second, third


def transposed(a: Matrix) -> Matrix:
    """Return the transpose, which is a rotation's inverse."""
    first, second, third = zip(*a, strict=True)
    return first, second, third


def product(a: Matrix, b: Matrix) -> Matrix:
    """Return the matrix product a b."""
    if a == IDENTITY:
        return b
    x, y, z = transposed(b)
    return transposed((rotated(a, x), rotated(a, y), rotated(a, z)))


def rotated(a: Matrix, vector: Vector) -> Vector:
    """Return the product of a matrix and a vector."""
    return dot(a[0], vector), dot(a[1], vector), dot(a[2], vector)


def summed(a: Vector, b: Vector) -> Vector:
    """Return the sum of two vectors."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


def scaled(factor: Fraction, vector: Vector) -> Vector:
    """Return a vector times a number."""
    return factor * vector[0], factor * vector[1], factor * vector[2]


def rotated_tensor(a: Matrix, tensor: Tensor) -> Tensor:
    """Return a T a^T of a symmetric tensor (xx, xy, xz, yy, yz, zz)."""
    if a == IDENTITY:
        return tensor
    xx, xy, xz, yy, yz, zz = tensor
    half = product(a, ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz)))
    x, y, z = product(half, transposed(a))
    return *x, y[1], y[2], z[2]


def dot(a: Vector, b: Vector) -> Fraction:
    """Return the scalar product."""
    total = _ZERO
    for x, y in zip(a, b, strict=True):
        # zeros are common here, and skipping them is what makes exact arithmetic cheap
        if x and y:
            total += x * y
    return total
