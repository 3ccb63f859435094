"""Find which angles of an arm can be added up, and write products of their cosines and sines as sums of multiples."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

from flint import fmpq, fmpz_poly
from sympy import Add, Expr, cos, sin

from spelgen.arm.arm import Arm
from spelgen.certificate.axes import Axes, is_plain
from spelgen.certificate.terms import Factors


def parallel_runs(arm: Arm) -> list[list[int]]:
    """Return the turning coordinates by runs of axes that are parallel however the arm moves.

    Where bodies share coordinates, each is a run of its own.
    """
    turning = sorted({body.coordinate for body in arm.bodies if body.kind == "revolute"})
    if not is_plain(arm):
        return [[joint] for joint in turning]
    axes = Axes(arm)
    runs: list[list[int]] = []
    for joint in turning:
        if runs and axes.parallel(joint, runs[-1][-1]):
            runs[-1].append(joint)
        else:
            runs.append([joint])
    return runs


def multiple_angles(powers: Sequence[tuple[Expr, int, int]]) -> list[tuple[Factors, fmpq]]:
    """Return the product of powers of cosine and sine, given as (angle, power of cos, power of sin), as a sum.

    Each term is a multiple of one or of a cosine or sine of a sum of the angles.
    """
    # cos = (e + 1/e) / 2 and sin = (e - 1/e) / 2i with e = exp(iq): coefficients by powers of e, from the highest
    spectra = []
    scale = fmpq(1)
    sines = 0
    for _, cosine, sine in powers:
        polynomial = fmpz_poly([1, 0, 1]) ** cosine * fmpz_poly([-1, 0, 1]) ** sine
        degree = polynomial.degree()  # twice the highest multiple of the angle
        spectra.append([(k - degree // 2, int(polynomial[k])) for k in range(degree, -1, -2)])
        scale /= 2 ** (cosine + sine)
        sines += sine
    function = cos
    if sines % 2:
        function = sin
    scale *= (-1) ** (sines // 2)
    result: list[tuple[Factors, fmpq]] = []
    for harmonic in product(*spectra):
        coefficient = scale
        multiples = []
        for (angle, _, _), (multiple, number) in zip(powers, harmonic, strict=True):
            coefficient *= number
            if multiple:
                multiples.append((multiple, angle))
        # odd powers leave gaps in the spectrum
        if coefficient == 0:
            continue
        if not multiples:
            result.append(((), coefficient))
        elif multiples[0][0] > 0:  # a harmonic and its opposite, at minus the angle, add up
            total = Add(*(multiple * angle for multiple, angle in multiples), evaluate=False)
            result.append(((function(total, evaluate=False),), 2 * coefficient))
    return result
