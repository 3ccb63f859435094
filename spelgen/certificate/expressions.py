"""Write polynomials in cosines, sines and distances as SymPy expressions, in one canonical way.

Products of cosines and sines along a run of joints with parallel axes become cosines and sines of sums of these
angles. Other ways (powers of single angles, common factors of several terms) made long formulas a fifth shorter, and
those that a person reads no shorter.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from itertools import product

from flint import fmpq, fmpq_mpoly, fmpq_mpoly_ctx
from sympy import Add, Expr, Mul, Rational, Symbol, cos, sin
from sympy.core.parameters import distribute

from spelgen.arm.arm import Arm
from spelgen.certificate.axes import Axes, is_plain
from spelgen.structure.recursion import base_denominators

Terms = dict[Expr, fmpq]
"""A sum of products of distances, cosines and sines, each times a number that is not 0."""


@cache
def coordinate(joint: int) -> Symbol:
    """Return the position of a joint, counted from 0."""
    return Symbol(f"q{joint + 1}", real=True)


def parameter(name: str) -> Symbol:
    """Return a base parameter, or an inertial parameter of a body."""
    return Symbol(name, real=True)


def weighted_sum(terms: Mapping[Expr, fmpq]) -> Expr:
    """Return the sum of the expressions, each times its number."""
    # SymPy would else make 2*(a + b) into 2*a + 2*b
    with distribute(False):
        return Add(*(Rational(int(x.p), int(x.q)) * expression for expression, x in terms.items()))


class PolynomialWriter:
    """Write the polynomials of one arm, over s1, c1, q1, s2, ..."""

    def __init__(self, arm: Arm, context: fmpq_mpoly_ctx):
        generators = context.gens()
        self._circles = []
        for sine, cosine in zip(generators[::3], generators[1::3], strict=True):
            self._circles.append(sine**2 + cosine**2 - 1)
        self._angles: list[Expr] = []
        for joint, denominator in enumerate(base_denominators(arm)):
            # mimic joints may turn by fractions of a coordinate
            self._angles.append(coordinate(joint) / denominator)
        self._runs = parallel_runs(arm)

    def reduced(self, polynomial: fmpq_mpoly) -> fmpq_mpoly:
        """Return the same function with every sine to the first power at most."""
        for circle in self._circles:
            polynomial %= circle
        return polynomial

    def terms(self, polynomial: fmpq_mpoly) -> Terms:
        """Return a polynomial with its products of cosines and sines as multiple angles."""
        result: Terms = {}
        for exponents, coefficient in polynomial.terms():
            distances = Mul(*(coordinate(k) ** power for k, power in enumerate(exponents[2::3])))
            sums = []
            for run in self._runs:
                powers = [(exponents[3 * joint], exponents[3 * joint + 1]) for joint in run]
                sums.append(multiple_angles([self._angles[joint] for joint in run], powers))
            for waves in product(*sums):
                value = coefficient
                for _, number in waves:
                    value *= number
                key = Mul(distances, *(wave for wave, _ in waves))
                result[key] = result.get(key, fmpq(0)) + value
        return {key: value for key, value in result.items() if value != 0}


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


def multiple_angles(angles: Sequence[Expr], powers: Sequence[tuple[int, int]]) -> list[tuple[Expr, fmpq]]:
    """Return a product of powers of the angles' sines and cosines as a sum of cosines and sines of their sums."""
    # a wave is cos(m . angles - quarters pi/2), in which sin(x) is cos(x - pi/2)
    waves = {((0,) * len(angles), 0): fmpq(1)}
    for joint, (sines, cosines) in enumerate(powers):
        for quarter in [1] * sines + [0] * cosines:
            products: dict[tuple[tuple[int, ...], int], fmpq] = {}
            for (multiples, quarters), value in waves.items():
                # cos a cos b = (cos(a + b) + cos(a - b)) / 2
                for sign in (1, -1):
                    moved = (*multiples[:joint], multiples[joint] + sign, *multiples[joint + 1 :])
                    key = (moved, (quarters + sign * quarter) % 4)
                    products[key] = products.get(key, fmpq(0)) + value / 2
            waves = products
    result = []
    for (multiples, quarters), value in waves.items():
        angle = Add(*(multiple * angle for multiple, angle in zip(multiples, angles, strict=True)))
        # SymPy writes cos(-a) as cos(a) and sin(-a) as -sin(a)
        wave = sin(angle) if quarters % 2 else cos(angle)
        sign, function = wave.as_coeff_Mul()
        if sign != 0:
            result.append((function, value * int(sign) * (1 - 2 * (quarters // 2))))
    return result


def grouped(functions: Sequence[tuple[Symbol, Terms]]) -> Expr:
    """Return the sum of parameters times functions; parameters with one function, up to a factor, together."""
    groups: dict[tuple[tuple[Expr, fmpq], ...], dict[Expr, fmpq]] = {}
    for symbol, terms in functions:
        leading = next(iter(terms.values()))
        unit = tuple((function, value / leading) for function, value in terms.items())
        groups.setdefault(unit, {})[symbol] = leading
    total: dict[Expr, fmpq] = {}
    for unit, parameters in groups.items():
        first = next(iter(parameters.values()))
        # a size stands before the brackets only where it leaves none inside
        size = fmpq(1)
        if any(abs(value) != 1 for _, value in unit):
            size = abs(first)
        function = weighted_sum({term: value * size for term, value in unit})
        if function == 1 or len(parameters) == 1:
            for symbol, value in parameters.items():
                total[Mul(symbol, function)] = value / size
        else:
            # the sign of the first goes outside, so that no bracket begins with a minus
            outside = size * first / abs(first)
            symbols = weighted_sum({symbol: value / outside for symbol, value in parameters.items()})
            total[Mul(symbols, function)] = outside / size
    # a common factor before the sum: 2*(a + b) is shorter than 2*a + 2*b
    sizes = {abs(value) for value in total.values()}
    if len(sizes) != 1:
        return weighted_sum(total)
    (size,) = sizes
    inside = weighted_sum({term: value / size for term, value in total.items()})
    return weighted_sum({inside: size})
