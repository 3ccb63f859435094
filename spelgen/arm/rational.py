"""Exact rotations and vectors as arrays of fractions, and rational approximations of rotations in floating point."""

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from math import atan2, cos, lcm, pi, sin, tan

import numpy as np

Vector = tuple[Fraction, ...]
Matrix = tuple[Vector, ...]


@dataclass(frozen=True)
class GeometryTuning:
    """Tolerances with which rounded numbers of a URDF are replaced by exact values, such as 1.5708 by pi/2."""

    # [rad, 1] If rounding to an exact value changes an angle, or a component of a unit axis, by at most this number,
    # the change is not reported.
    notable: float = 1e-9
    # [1] An element of a rotation matrix below this bound is a rounding error and is replaced by 0. A product of
    # inertia is replaced by 0 if its ratio to the largest moment of inertia is below this bound.
    zero_noise: float = 1e-12
    # [rad] Largest error of a rational rotation. It is thousands of times smaller than the error of any calibration.
    rotation_error: float = 1e-11
    # [1] Largest denominators of rational approximations. The smallest bound is tried first, so that fractions are
    # short.
    denominators: tuple[int, ...] = (10**7, 10**10, 10**13)


TUNING = GeometryTuning()

IDENTITY: np.ndarray = np.eye(3, dtype=object) * Fraction(1)
ZERO = np.array([Fraction(0)] * 3)


def exact(value: float) -> Fraction:
    """Return the shortest decimal number that rounds to a float, as a fraction: 1/10 for 0.1."""
    return Fraction(repr(value))


def bounded(value: Fraction) -> Fraction:
    """Return a number, rounded to the nearest float if its denominator has more than 4,096 bits.

    Such a number results from dozens of consecutive rational approximations of rotations: it is not exact, and rounding
    loses nothing. Without the bound, arithmetic could take hours for a file from an untrusted source.
    """
    return value if value.denominator.bit_length() <= 4096 else Fraction(float(value))


def rounded_angle(angle: float, tolerance: float) -> float:
    """Return an angle [rad] rounded to a special angle if there is one close to it, otherwise the angle itself.

    Special angles are multiples of pi/2 within ``tolerance`` [rad], and multiples of pi/12, pi/8 and pi/5 within 2e-5
    rad. A tolerance of 0 disables rounding.
    """
    if tolerance == 0.0:
        return angle
    # {divisor: tolerance [rad]}: special angles are multiples of pi / divisor, as found in the URDFs of 189 arms. The
    # tolerance of pi/12, pi/8 and pi/5 is small, because URDFs also contain angles of exactly 0.26, 0.39 and 0.63 rad,
    # which are close to these fractions of pi and must not be rounded to them.
    limits = {2: tolerance, 12: 2e-5, 8: 2e-5, 5: 2e-5}
    for divisor, limit in limits.items():
        step = pi / divisor
        nearest = round(angle / step) * step
        if abs(nearest - angle) <= limit:
            return nearest
    return angle


def rotation_from_rpy(rpy: Sequence[float]) -> np.ndarray:
    """Return the rotation Rz(yaw) Ry(pitch) Rx(roll), (3, 3) float64; rpy: roll, pitch and yaw of a URDF [rad]."""
    # SciPy's Rotation is not used: one call takes longer than all other operations for a joint together.
    (cr, cp, cy), (sr, sp, sy) = map(cos, rpy), map(sin, rpy)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def rotation_about(axis: np.ndarray, angle: float) -> np.ndarray:
    """Return the rotation (3, 3), float64, by ``angle`` [rad] about the unit vector ``axis`` (3,) (Rodrigues)."""
    cross = np.cross(np.eye(3), axis)
    return np.eye(3) + sin(angle) * cross + (1.0 - cos(angle)) * (cross @ cross)


def alignment(axis: np.ndarray) -> np.ndarray:
    """Return a rotation R (3, 3) with R z = ``axis``, a unit vector (3,).

    For an axis along +-x, +-y or +-z, R is a signed permutation. For any other axis, R is the signed permutation for
    the closest coordinate axis, followed by the smallest rotation from this axis to ``axis``: in this way, four
    elements of R are zero if a component of ``axis`` is zero.
    """
    index = int(np.argmax(np.abs(axis)))
    sign = 1.0 if axis[index] > 0 else -1.0
    closest = np.zeros(3)
    closest[index] = sign
    cross = np.cross(closest, axis)
    skew = np.cross(np.eye(3), cross)
    smallest = np.eye(3) + skew + skew @ skew / (1.0 + float(closest @ axis))
    # `columns` are the columns of a signed permutation matrix that maps +z to the coordinate axis, + or -, that is
    # closest to `axis`.
    first, second = np.eye(3)[(index + 1) % 3], np.eye(3)[(index + 2) % 3]
    columns = [first, second, closest] if sign > 0 else [second, first, closest]
    if sign < 0 and index == 2:
        # For the axis -z, the rotation is by pi about x; parameters of existing modules depend on this convention.
        columns = [first, -second, closest]
    return np.asarray(smallest @ np.stack(columns, axis=1))


def exact_rotation(rotation: np.ndarray, error: float = TUNING.rotation_error) -> np.ndarray:
    """Return a rational approximation (3, 3), exactly orthogonal, of a float64 rotation (3, 3).

    Elements differ by less than ``error``. The components of the quaternion, divided by the largest one, are replaced
    by close fractions: the rotation matrix of any rational quaternion is rational (Euler-Rodrigues). If a zero element
    of ``rotation`` becomes nonzero in this way, the result of `_rotation_with_zero` is returned: an approximation in
    which the first zero element is exactly zero.
    """
    ratios = _quaternion_ratios(rotation)
    candidate = IDENTITY
    # The smallest bound of the denominators is tried first, because exact arithmetic with short fractions is fast.
    for bound in TUNING.denominators:
        candidate = _rotation_of([Fraction(ratio).limit_denominator(bound) for ratio in ratios])
        if np.abs(candidate.astype(float) - rotation).max() < error:
            break
    if not lost_zeros(candidate, rotation):
        return candidate
    row, column = np.argwhere(np.abs(rotation) < TUNING.zero_noise)[0].tolist()
    return _rotation_with_zero(rotation, row, column, error)


def _quaternion_ratios(rotation: np.ndarray) -> list[float]:
    """Return the quaternion (w, x, y, z) of a rotation (3, 3), divided by its largest component (Shepperd's method).

    SciPy's Rotation is not used, because its checks of the input take 0.2 ms per call.
    """
    trace = float(np.trace(rotation))
    # `squares` is 4 q q^T for the unit quaternion q. Each row is proportional to q; the row with the largest diagonal
    # element has the smallest rounding errors.
    squares = np.empty((4, 4))
    squares[0, 0] = 1.0 + trace
    squares[1:, 1:] = rotation + rotation.T + (1.0 - trace) * np.eye(3)
    antisymmetric = rotation - rotation.T
    squares[0, 1:] = squares[1:, 0] = antisymmetric[2, 1], antisymmetric[0, 2], antisymmetric[1, 0]
    largest = int(np.argmax(np.diag(squares)))
    ratios = squares[largest] / squares[largest, largest]
    ratios[np.abs(ratios) < TUNING.zero_noise] = 0.0
    return list(map(float, ratios))


def lost_zeros(candidate: np.ndarray, rotation: np.ndarray) -> int:
    """Return the number of zero elements of ``rotation`` (3, 3) that are nonzero in its approximation ``candidate``."""
    return int(np.count_nonzero(candidate[np.abs(rotation) < TUNING.zero_noise]))


def _rotation_with_zero(rotation: np.ndarray, row: int, column: int, error: float) -> np.ndarray:
    """Return a rational approximation (3, 3) of a float64 rotation whose element (``row``, ``column``) is zero.

    The element of the approximation is exactly zero. The approximation is the product of a rotation about the
    coordinate axis ``row``, a signed permutation, and a rotation about the coordinate axis ``column``. error: largest
    error of an element.
    """
    first = _turn(row, rotation[(row + 1) % 3, column], rotation[(row + 2) % 3, column], error)
    last = _turn(column, rotation[row, (column + 1) % 3], -rotation[row, (column + 2) % 3], error)
    between = np.rint(first.T.astype(float) @ rotation @ last.T.astype(float)).astype(int)
    return np.asarray(first @ between @ last)


def _turn(axis: int, cosine: float, sine: float, error: float) -> np.ndarray:
    """Return a rational approximation (3, 3) of a rotation about the coordinate axis 0, 1 or 2.

    cosine, sine: cosine and sine of the angle in float64. Both may have a common positive factor, because only their
    ratio and signs are used. error: upper bound of the errors of the elements if two such rotations are multiplied.
    """
    # The angle is split into exact quarter turns and a remainder: only the remainder is approximated, so that the
    # approximations of 45 and 135 degrees differ by exactly a right angle. The remainder is in [-`eighth`, pi/2 -
    # `eighth`), from -40 to 50 degrees. `eighth` is less than an eighth turn: with bounds of +-45 degrees, rounding
    # errors would change the number of quarter turns of angles of +-45 degrees, which are common.
    eighth = 0.7
    quarter, angle = divmod(atan2(sine, cosine) + eighth, pi / 2)
    tangent = tan((angle - eighth) / 2)
    t = Fraction(0)
    if abs(tangent) >= TUNING.zero_noise:
        for bound in TUNING.denominators:
            t = Fraction(tangent).limit_denominator(bound)
            # The error of t = tan(angle / 2) must be below error / 4: the error of the angle is up to twice the error
            # of t, and `_rotation_with_zero` multiplies two such rotations.
            if abs(float(t) - tangent) < error / 4:
                break
    norm = 1 + t * t
    c, s = (1 - t * t) / norm, 2 * t / norm
    for _ in range(int(quarter) % 4):
        c, s = -s, c
    return turn_about(axis, c, s)


def turn_about(axis: int, cosine: Fraction, sine: Fraction) -> np.ndarray:
    """Return the rotation (3, 3) about the coordinate axis 0, 1 or 2 by the angle with these exact cosine and sine."""
    rotation = IDENTITY.copy()
    first, second = (axis + 1) % 3, (axis + 2) % 3
    rotation[first, first] = rotation[second, second] = cosine
    rotation[first, second] = -sine
    rotation[second, first] = sine
    return rotation


def _rotation_of(quaternion: Sequence[Fraction]) -> np.ndarray:
    """Return the exact rotation matrix (3, 3) of a rational quaternion (w, x, y, z) of any norm (Euler-Rodrigues)."""
    # All components of the quaternion are multiplied by their common denominator, because integers are faster than
    # fractions.
    common = lcm(*(component.denominator for component in quaternion))
    w, x, y, z = (int(component * common) for component in quaternion)
    v = np.array([x, y, z], dtype=object)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=object)
    # Euler-Rodrigues for a quaternion (w, v) of any norm: R = 1 + (2 w [v]x + 2 [v]x [v]x) / (w^2 + v.v).
    return np.asarray(IDENTITY + 2 * (w * cross + cross @ cross) * Fraction(1, w * w + v @ v))
