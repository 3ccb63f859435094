"""Polynomials in cosines, sines and distances as SymPy expressions in a canonical form.

Products of cosines and sines of consecutive joints with parallel axes become cosines and sines of sums of their angles.
Alternatives (powers of single angles, common factors of several terms) reduce the length of long formulas by 20 %, but
not the length of formulas that are short enough to be read.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache, lru_cache

from flint import fmpq, fmpq_mpoly, fmpq_mpoly_ctx
from sympy import Add, Expr, Integer, Rational, Symbol, cos, sin
from sympy.core.parameters import distribute

from spelgen.arm.arm import Chain
from spelgen.certificate.axes import Axes, is_plain
from spelgen.structure.recursion import base_denominators

Terms = dict[Expr, fmpq]
"""A linear combination of products of distances, cosines and sines, with nonzero coefficients."""


@cache
def coordinate(joint: int) -> Symbol:
    """Return the symbol of the position of a joint; joints are counted from 0."""
    return Symbol(f"q{joint + 1}", real=True)


def parameter(name: str) -> Symbol:
    """Return the symbol of a base parameter, or of an inertial parameter of a body."""
    return Symbol(name, real=True)


def weighted_sum(terms: Mapping[Expr, fmpq]) -> Expr:
    """Return the linear combination of the expressions with these coefficients."""
    products = []
    # Otherwise SymPy expands 2*(a + b) to 2*a + 2*b.
    with distribute(False):
        for expression, number in terms.items():
            products.append(Rational(int(number.p), int(number.q)) * expression)
    return Add(*products)


class PolynomialWriter:
    """Conversion of the polynomials of an arm, over s1, c1, q1, s2, ..., to terms."""

    def __init__(self, arm: Chain, context: fmpq_mpoly_ctx):
        generators = context.gens()
        self._circles = []
        for sine, cosine in zip(generators[::3], generators[1::3], strict=True):
            self._circles.append(sine**2 + cosine**2 - 1)
        self._angles: list[Expr] = []
        for joint, denominator in enumerate(base_denominators(arm)):
            # Angles of mimic joints are multiples of a fraction of the coordinate.
            self._angles.append(coordinate(joint) / denominator)
        self._runs = parallel_runs(arm)

    def reduced(self, polynomial: fmpq_mpoly) -> fmpq_mpoly:
        """Return the polynomial of the same function in which the power of every sine is at most 1."""
        for circle in self._circles:
            # The remainder modulo s^2 + c^2 - 1, with s as the leading variable.
            polynomial %= circle
        return polynomial

    def terms(self, polynomial: fmpq_mpoly) -> Terms:
        """Return the terms of a polynomial, with cosines and sines of sums of angles in place of products."""
        result: Terms = {}
        for exponents, coefficient in polynomial.terms():
            distances = Integer(1)
            for joint, power in enumerate(exponents[2::3]):
                distances *= coordinate(joint) ** power
            products = [(distances, coefficient)]
            for run in self._runs:
                powers = tuple((self._angles[k], exponents[3 * k], exponents[3 * k + 1]) for k in run)
                factors, products = products, []
                for factor, value in factors:
                    for wave, number in multiple_angles(powers).items():
                        products.append((factor * wave, value * number))
            for factor, value in products:
                result[factor] = result.get(factor, fmpq(0)) + value
        return {factor: value for factor, value in result.items() if value != 0}


def parallel_runs(arm: Chain) -> list[list[int]]:
    """Return the revolute coordinates in groups of consecutive axes that are parallel at every configuration.

    If bodies share coordinates (mimic joints), each coordinate is its own group.
    """
    turning = sorted({body.coordinate for body in arm.bodies if body.joint_type == "revolute"})
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


@lru_cache(4096)
def multiple_angles(powers: tuple[tuple[Expr, int, int], ...]) -> Terms:
    """Return a product of powers, given as (angle, power of sin, power of cos), as a sum.

    Each term is a constant, or a multiple of a cosine or sine of a sum of the angles.
    """
    # A wave (angle, k) is cos(angle - k pi/2); sin(x) = cos(x - pi/2).
    waves: dict[tuple[Expr, int], fmpq] = {(Integer(0), 0): fmpq(1)}
    for angle, sines, cosines in powers:
        for quarter in [1] * sines + [0] * cosines:
            products: dict[tuple[Expr, int], fmpq] = {}
            for (total, quarters), value in waves.items():
                # cos a cos b = (cos(a + b) + cos(a - b)) / 2
                for sign in (1, -1):
                    wave = (total + sign * angle, (quarters + sign * quarter) % 4)
                    products[wave] = products.get(wave, fmpq(0)) + value / 2
            waves = products
    result: Terms = {}
    for (total, quarters), value in waves.items():
        function = cos(total)
        if quarters % 2:
            function = sin(total)
        # SymPy simplifies cos(-a) to cos(a) and sin(-a) to -sin(a).
        sign, function = function.as_coeff_Mul()
        if quarters > 1:
            sign = -sign
        result[function] = result.get(function, fmpq(0)) + value * int(sign)
    return result


def grouped(functions: Sequence[tuple[Symbol, Terms]]) -> Expr:
    """Return the sum of parameters times functions; parameters with proportional functions form one product."""
    groups: dict[tuple[tuple[Expr, fmpq], ...], dict[Expr, fmpq]] = {}
    for symbol, terms in functions:
        leading = next(iter(terms.values()))
        # Proportional functions have the same coefficients relative to their first term.
        unit = tuple((function, value / leading) for function, value in terms.items())
        groups.setdefault(unit, {})[symbol] = leading
    total = []
    for unit, parameters in groups.items():
        factor = fmpq(1)
        # The function of a single parameter retains its coefficients, which are dimensions of the arm.
        if len(parameters) == 1:
            factor = abs(next(iter(parameters.values())))
        symbols = weighted_sum({symbol: value / factor for symbol, value in parameters.items()})
        total.append(symbols * weighted_sum({function: value * factor for function, value in unit}))
    return Add(*total)
