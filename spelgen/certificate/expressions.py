"""SymPy expressions of closed forms from polynomials of an arm, and their output as text and Python.

The polynomials are entries of M, or the potential energy V, in sines, cosines and positions of joints. For consecutive
joints with parallel axes, products of cosines and sines are expressed as cosines and sines of sums of angles. Other
simplifications (powers of single angles, common factors of several terms) are not used: they shorten long formulas by
20 %, but not the formulas that are short enough to be read. Decimals in text have at most twelve digits. Python for
SymPy has exact fractions, except for fractions with more than 17 digits.
"""

import re
import textwrap
from collections.abc import Mapping, Sequence
from functools import cache, lru_cache

from flint import fmpq, fmpq_mpoly, fmpq_mpoly_ctx
from sympy import Add, Expr, Float, Integer, Rational, Symbol, cos, sin
from sympy.core.parameters import distribute
from sympy.printing.str import StrPrinter

from spelgen.arm.arm import Chain
from spelgen.certificate.axes import Axes, is_plain
from spelgen.structure.recursion import base_denominators

FLOAT_DIGITS = 17  # number of significant decimal digits that suffice for any double
_FIXED = "\N{NO-BREAK SPACE}"  # This character replaces blanks at which textwrap must not break a line.
Terms = dict[Expr, fmpq]
"""A sum of terms {product of positions of prismatic joints, cosines and sines: nonzero coefficient}."""


@cache
def coordinate(joint: int) -> Symbol:
    """Return the symbol of the position of a joint: q1 for joint 0."""
    return Symbol(f"q{joint + 1}", real=True)


def parameter(name: str) -> Symbol:
    """Return the symbol of a base parameter, or of an inertial parameter of a body."""
    return Symbol(name, real=True)


def weighted_sum(terms: Mapping[Expr, fmpq]) -> Expr:
    """Return the sum of coefficient * expression over ``terms``, {expression: coefficient}."""
    products = []
    # Without `distribute(False)`, SymPy expands 2*(a + b) to 2*a + 2*b.
    with distribute(False):
        for expression, number in terms.items():
            products.append(Rational(int(number.p), int(number.q)) * expression)
    return Add(*products)


class PolynomialWriter:
    """Convert polynomials, the factors of inertial parameters in M or in the potential energy, to SymPy terms.

    The variables of the polynomials are s1, c1, q1, s2, ...: sine, cosine and position of each coordinate (see
    `Expansion`).

    Args:
        arm: the arm.
        context: polynomial ring of FLINT with these variables.
    """

    def __init__(self, arm: Chain, context: fmpq_mpoly_ctx):
        generators = context.gens()
        waves = zip(generators[::3], generators[1::3], strict=True)
        self._circles = [sine**2 + cosine**2 - 1 for sine, cosine in waves]
        # The variables s and c of a coordinate q are the sine and cosine of q / d. The integer d is chosen so that the
        # angles of its mimic joints are integer multiples of q / d.
        fractions = enumerate(base_denominators(arm))
        self._angles = [coordinate(joint) / denominator for joint, denominator in fractions]
        self._runs = parallel_runs(arm)

    def reduced(self, polynomial: fmpq_mpoly) -> fmpq_mpoly:
        """Return an equal polynomial in which the power of every sine is at most 1: s^2 is replaced by 1 - c^2."""
        for circle in self._circles:
            # A remainder modulo s^2 + c^2 - 1, with s as the leading variable, has no s^2.
            polynomial %= circle
        return polynomial

    def terms(self, polynomial: fmpq_mpoly) -> Terms:
        """Return a polynomial as SymPy terms, {term: coefficient}.

        Products of cosines and sines of parallel joints are replaced by cosines and sines of sums of angles.
        """
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
    """Return groups of consecutive revolute coordinates whose axes are parallel at all configurations.

    A coordinate without a parallel neighbour is a group of one. In an arm with mimic joints or branches, each revolute
    coordinate is a group of one.
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
    """Return a product of powers of sines and cosines as a sum {cosine or sine of a sum of angles: coefficient}.

    powers: one tuple (angle, power of its sine, power of its cosine) per angle of the product.
    """
    # A key (angle, k) of `waves` represents cos(angle - k pi/2), for example k = 1: cos(x - pi/2) = sin(x).
    waves = {(Integer(0), 0): fmpq(1)}
    for angle, sines, cosines in powers:
        for quarter in [1] * sines + [0] * cosines:
            products: dict[tuple[Expr, int], fmpq] = {}
            for (total, quarters), value in waves.items():
                # Each product of cosines becomes a sum: cos a cos b = (cos(a + b) + cos(a - b)) / 2.
                for sign in (1, -1):
                    wave = (total + sign * angle, (quarters + sign * quarter) % 4)
                    products[wave] = products.get(wave, fmpq(0)) + value / 2
            waves = products
    result: Terms = {}
    for (total, quarters), value in waves.items():
        function = sin(total) if quarters % 2 else cos(total)
        # SymPy simplifies sin(-a) to -sin(a): the sign is separated from the function and multiplied with its
        # coefficient.
        sign, function = function.as_coeff_Mul()
        if quarters > 1:
            sign = -sign
        result[function] = result.get(function, fmpq(0)) + value * int(sign)
    return result


def grouped(functions: Sequence[tuple[Symbol, Terms]]) -> Expr:
    """Return a closed form, the sum of parameter * function over all pairs (parameter, function), as an expression.

    Parameters a and b with proportional functions f and 2 f are combined: (a + 2 b) f in place of a f + b (2 f).
    """
    groups: dict[tuple[tuple[Expr, fmpq], ...], dict[Expr, fmpq]] = {}
    for symbol, terms in functions:
        leading = next(iter(terms.values()))
        # Two functions are proportional if their coefficients are equal after division by the coefficient of their
        # first term.
        unit = tuple((function, value / leading) for function, value in terms.items())
        groups.setdefault(unit, {})[symbol] = leading
    total = []
    for unit, parameters in groups.items():
        # A group contains the parameters whose functions are proportional. If it has only one parameter, the function
        # keeps its coefficients: they are lengths of the arm, which users recognise. Otherwise, the function is divided
        # by its first coefficient.
        factor = abs(next(iter(parameters.values()))) if len(parameters) == 1 else fmpq(1)
        symbols = weighted_sum({symbol: value / factor for symbol, value in parameters.items()})
        total.append(symbols * weighted_sum({function: value * factor for function, value in unit}))
    return Add(*total)


def text(expression: Expr) -> str:
    """Return an expression as plain text; fractions are decimals of at most twelve digits."""
    return str(StrPrinter({"full_prec": False}).doprint(_rounded(expression, 1, 12)))


def python(expression: Expr) -> str:
    """Return an expression as Python code for SymPy, with exact fractions up to 17 digits; longer ones are decimals."""
    rounded = _rounded(expression, 10**FLOAT_DIGITS, FLOAT_DIGITS)
    return str(_PythonPrinter({"sympy_integers": True}).doprint(rounded))


def lines(formula: str, start: str, width: int, end: str = "") -> list[str]:
    """Return the text start + formula + end as lines of at most ``width`` characters.

    A line may be longer if it has no blank at which a break is permitted.
    """
    indent = " " * (len(start) - len(start.lstrip()) + 4)
    # Lines of a formula are not broken after a sign, within an argument of cos or sin, or within short brackets.
    formula = re.sub(r"([+-]) ", rf"\1{_FIXED}", formula)
    brackets = re.findall(r"\((?:[^()]|\([^()]*\))+\)", formula)
    angles = re.findall(r"(?:cos|sin)\b.*?\)", formula)
    for text in dict.fromkeys([*brackets, *angles]):
        if len(text) < width // 2 or text in angles:
            formula = formula.replace(text, text.replace(" ", _FIXED))
    wrapped = textwrap.fill(
        start + formula + end, width, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False
    )
    return wrapped.replace(_FIXED, " ").split("\n")


class _PythonPrinter(StrPrinter):  # type: ignore[misc]  # SymPy has no types
    def _print_Add(self, expression: Add, order: str | None = None) -> str:
        """Print a long sum as one call of ``Add``, because Python cannot parse thousands of nested additions."""
        if len(expression.args) <= 20:
            return str(super()._print_Add(expression, order))
        return f"Add({', '.join(map(self._print, expression.args))})"


def _rounded(expression: Expr, largest: int, digits: int) -> Expr:
    """Return the expression with decimals of ``digits`` digits in place of long fractions.

    A fraction is long if its numerator or denominator exceeds ``largest``.
    """
    decimals = {}
    for number in expression.atoms(Rational):
        if not number.is_Integer and max(abs(number.p), number.q) > largest:
            decimals[number] = Float(number, digits)
    # Without `distribute(False)`, SymPy expands products of numbers and sums.
    with distribute(False):
        return expression.xreplace(decimals)
