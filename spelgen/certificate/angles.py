"""Which angles of an arm can be added up, and products of their cosines and sines as sums of multiple angles."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from math import prod

from flint import fmpq, fmpz_poly
from sympy import Add, Expr, cos, sin

from spelgen.arm.arm import Arm
from spelgen.certificate.axes import Axes, is_plain
from spelgen.certificate.terms import Factors


def parallel_runs(arm: Arm) -> list[dict[int, int]]:
    """The turning coordinates by runs of axes that are parallel however the arm moves, each with its sense
    relative to the first; where bodies share coordinates, each for itself.
    """
    if not is_plain(arm):
        return [{joint: 1} for joint in sorted({x.coordinate for x in arm.bodies if x.kind == "revolute"})]
    axes, runs = Axes(arm), list[dict[int, int]]()
    for joint, slides in enumerate(axes.slides):
        if not slides and runs and axes.parallel(joint, max(runs[-1])):
            runs[-1][joint] = -1 if axes.opposed(joint, min(runs[-1])) else 1
        elif not slides:
            runs.append({joint: 1})
    return runs


def multiple_angles(powers: Sequence[tuple[Expr, int, int]]) -> list[tuple[Factors, fmpq]]:
    """The product of powers of cosine and sine, given as (angle, power of cos, power of sin), as a sum of
    multiples of no factor or of one: of a cosine or sine of a sum of the angles.
    """
    sines = sum(sine for _, _, sine in powers)
    scale = fmpq((-1) ** (sines // 2), 2 ** sum(cosine + sine for _, cosine, sine in powers))
    # cos = (e + 1/e) / 2 and sin = (e - 1/e) / 2i with e = exp(iq): coefficients by powers of e, from the highest
    spectra = []
    for _, cosine, sine in powers:
        polynomial = fmpz_poly([1, 0, 1]) ** cosine * fmpz_poly([-1, 0, 1]) ** sine
        spectra.append([(k - cosine - sine, int(polynomial[k])) for k in range(polynomial.degree(), -1, -2)])
    found: list[tuple[Factors, fmpq]] = []
    for harmonic in product(*spectra):
        coefficient = scale * prod(number for _, number in harmonic)
        sense = next((k for k, _ in harmonic if k), 0)
        if sense < 0 or coefficient == 0:
            continue  # a harmonic and its opposite, at minus the angle, add up
        multiples = [k * angle for (angle, _, _), (k, _) in zip(powers, harmonic, strict=True) if k]
        function = (sin if sines % 2 else cos)(Add(*multiples, evaluate=False), evaluate=False)
        found.append(((function,), 2 * coefficient) if sense else ((), coefficient))
    return found
