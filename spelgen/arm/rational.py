"""Exact rotations and vectors, arrays of fractions, and how a measured angle becomes one of them."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from math import atan2, cos, lcm, pi, sin, tan

import numpy as np

from spelgen.arm.tuning import TUNING

Vector = tuple[Fraction, Fraction, Fraction]
Matrix = tuple[Vector, Vector, Vector]


IDENTITY: np.ndarray = np.eye(3, dtype=object) * Fraction(1)
ZERO = np.array([Fraction(0)] * 3)


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


def exact_rotation(rotation: np.ndarray) -> np.ndarray:
    """Return a rational rotation within 1e-11 of a float64 one, exactly orthogonal, with zeros where it has zeros.

    The unit quaternion is divided by its largest component and each ratio replaced by a nearby fraction; the
    rotation of an unnormalised rational quaternion is rational (Euler-Rodrigues). That may miss a zero which
    the ratios only make together; one turn before and one behind a signed permutation then keep it.
    """
    ratios = _quaternion_ratios(rotation)
    candidate = IDENTITY
    # the shortest fractions that are near enough keep exact arithmetic fast
    for bound in TUNING.denominators:
        candidate = _rotation_of([Fraction(ratio).limit_denominator(bound) for ratio in ratios])
        if np.abs(candidate.astype(float) - rotation).max() < TUNING.rotation_error:
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


def lost_zeros(candidate: np.ndarray, rotation: np.ndarray) -> int:
    """Return how many zeros of a float64 rotation are none in the rational ``candidate``."""
    return int(np.count_nonzero(candidate[np.abs(rotation) < TUNING.zero_noise]))


def _rotation_with_zero(rotation: np.ndarray, row: int, column: int) -> np.ndarray:
    """Return the rational rotation near a float64 one of which this element is zero.

    It is a turn about axis ``row``, a signed permutation, and a turn about axis ``column``, so that the other zeros are
    those of the turns.
    """
    first = _turn(row, rotation[(row + 1) % 3, column], rotation[(row + 2) % 3, column])
    last = _turn(column, rotation[row, (column + 1) % 3], -rotation[row, (column + 2) % 3])
    between = np.rint(first.T.astype(float) @ rotation @ last.T.astype(float)).astype(int)
    result: np.ndarray = first @ between @ last
    return result


def _turn(axis: int, cosine: float, sine: float) -> np.ndarray:
    """Return the rational rotation about a coordinate axis by the angle of this cosine and sine."""
    # reduced to one eighth, so that 45 and 135 degrees are a right angle apart; no usual angle is on an edge
    quarter, angle = divmod(atan2(sine, cosine) + TUNING.eighth, pi / 2)
    tangent = tan((angle - TUNING.eighth) / 2)
    t = Fraction(0)
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


def turn_about(axis: int, cosine: Fraction, sine: Fraction) -> np.ndarray:
    """Return the rotation about the coordinate axis 0, 1 or 2 by the angle of this cosine and sine."""
    rotation = IDENTITY.copy()
    first, second = (axis + 1) % 3, (axis + 2) % 3
    rotation[first, first] = rotation[second, second] = cosine
    rotation[first, second] = -sine
    rotation[second, first] = sine
    return rotation


def _rotation_of(quaternion: Sequence[Fraction]) -> np.ndarray:
    """Return the rotation of a quaternion (w, x, y, z) of any length (Euler-Rodrigues)."""
    # over one denominator, whole numbers do: fractions are costly
    common = lcm(*(component.denominator for component in quaternion))
    w, x, y, z = (int(component * common) for component in quaternion)
    v = np.array([x, y, z], dtype=object)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=object)
    # R = 1 + (2 w [v]x + 2 [v]x [v]x) / (w^2 + v.v)
    turned: np.ndarray = IDENTITY + 2 * (w * cross + cross @ cross) * Fraction(1, w * w + v @ v)
    return turned


def as_vector(values: np.ndarray) -> Vector:
    """Return three fractions as a tuple, which can be a part of a key."""
    x, y, z = values
    return x, y, z


def as_matrix(rows: np.ndarray) -> Matrix:
    """Return nine fractions as tuples."""
    x, y, z = map(as_vector, rows)
    return x, y, z
