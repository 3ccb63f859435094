"""Entries of M, and V, as exact polynomials in the sines, cosines and positions of the joints.

The recursion of ``structure.recursion`` runs once and records its operations (lazy evaluation). The operations of an
entry are then executed with one inertial parameter set to 1 and all others to 0, which gives the polynomial that is the
coefficient of this parameter. Only requested entries are expanded, memory is limited to the polynomials of one
parameter, and an expansion is stopped before it exceeds its budget of multiplications.
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from typing import TypeAlias

from flint import Ordering, fmpq, fmpq_mpoly, fmpq_mpoly_ctx

from spelgen.arm.arm import Chain
from spelgen.structure.base_parameters import rational
from spelgen.structure.recursion import Position, energies

Value: TypeAlias = fmpq_mpoly | fmpq | int
"""A polynomial, or a number."""


class Deferred:
    """A recorded operation of the recursion, or a leaf of the expression (a constant or an inertial parameter)."""

    __slots__ = ("action", "operands")

    def __init__(self, action: str, *operands: Deferred | Value):
        self.action = action
        self.operands = operands

    def __add__(self, operand: Deferred | int) -> Deferred:
        # Zeros are common: a sum with zero is not recorded, so that it takes no time later.
        if isinstance(operand, int) and operand == 0:
            return self
        return Deferred("add", self, operand)

    __radd__ = __add__

    def __neg__(self) -> Deferred:
        return Deferred("multiply", self, -1)

    def __sub__(self, operand: Deferred | int) -> Deferred:
        return self + -operand

    def __rsub__(self, operand: int) -> Deferred:
        return -self + operand

    def __mul__(self, operand: Deferred | int) -> Deferred | int:
        if isinstance(operand, int) and operand == 0:
            return 0
        if isinstance(operand, int) and operand == 1:
            return self
        return Deferred("multiply", self, operand)

    __rmul__ = __mul__


class TooLarge(Exception):
    """An expansion needs more multiplications of terms than its budget has."""


class Budget:
    """Number of multiplications of polynomial terms that an expansion may still use."""

    def __init__(self, remaining: int):
        self.remaining = remaining

    def spend(self, cost: int) -> None:
        """Subtract ``cost`` from the remaining multiplications. Raises TooLarge if fewer remain.

        It is called before the multiplications are made.
        """
        if cost > self.remaining:
            raise TooLarge
        self.remaining -= cost


class Expansion:
    """The recorded operations of the recursion for M and V of ``arm``, which give polynomials in s1, c1, q1, s2, ...

    s, c and q with a number are sine, cosine and position of the coordinate with this number, from 1 (``Position``).
    """

    def __init__(self, arm: Chain):
        n = len(arm.coordinates)
        names: list[str] = []
        for k in range(n):
            names += (f"s{k + 1}", f"c{k + 1}", f"q{k + 1}")
        self.context = fmpq_mpoly_ctx.get(names, Ordering.lex)
        variables = [Deferred("constant", x) for x in self.context.gens()]
        self._parameters = [Deferred("parameter", index) for index in range(10 * len(arm.bodies))]
        positions = list(map(Position, variables[1::3], variables[::3], variables[2::3]))
        inertias: list[Sequence[Deferred]] = []
        for body in range(len(arm.bodies)):
            inertias.append(self._parameters[10 * body : 10 * body + 10])
        self.energies = energies(arm, positions, inertias, _number)

    def polynomial(self, element: Deferred | int, parameter: int, budget: Budget) -> fmpq_mpoly:
        """Return the coefficient, a polynomial, of an inertial parameter in an entry of M or in V.

        element: the recorded expression of the entry. parameter: the index of the inertial parameter, 10 body + i.
        Raises TooLarge.
        """
        # The keys are the id() of recorded operations, so that a subexpression that occurs twice is computed once.
        values: dict[int, Value] = {}
        for index, leaf in enumerate(self._parameters):
            values[id(leaf)] = int(index == parameter)
        # A stack replaces recursion: the operations of a long arm are nested deeper than the recursion limit of Python.
        stack = [element]
        while stack:
            node = stack[-1]
            missing = []
            if isinstance(node, Deferred) and id(node) not in values:
                missing = [x for x in node.operands if isinstance(x, Deferred) and id(x) not in values]
                if not missing:
                    values[id(node)] = _executed(node, values, budget)
            if missing:
                stack += missing
            else:
                stack.pop()
        return _value(element, values) + self.context.from_dict({})


def _executed(node: Deferred, values: dict[int, Value], budget: Budget) -> Value:
    if node.action == "constant":
        return _value(node.operands[0], values)
    x, y = (_value(operand, values) for operand in node.operands)
    if node.action == "add":
        return x + y
    if _is_zero(x) or _is_zero(y):
        return 0
    # The cost is the number of products of two terms: FLINT computes all of them before it collects like terms.
    budget.spend(_terms(x) * _terms(y))
    return x * y


def _value(operand: Deferred | Value, values: dict[int, Value]) -> Value:
    if isinstance(operand, Deferred):
        return values[id(operand)]
    return operand


def _is_zero(value: Value) -> bool:
    return isinstance(value, int) and value == 0


def _terms(value: Value) -> int:
    if isinstance(value, fmpq_mpoly):
        return max(1, len(value))
    return 1


def _number(value: Fraction) -> Deferred:
    return Deferred("constant", rational(value))
