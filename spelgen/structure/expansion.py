"""Expand entries of M, and V, to exact polynomials for one inertial parameter at a time, within a budget.

The recursion is run once over operations that are only written down; what an entry needs is then carried
out, for one parameter set to 1 and all others to 0. So nothing is expanded that was not asked for, memory
stays that of one parameter's polynomials, and an expansion that would take too long stops before it does.
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from typing import TypeAlias

from flint import Ordering, fmpq, fmpq_mpoly, fmpq_mpoly_ctx

from spelgen.arm.arm import Arm
from spelgen.structure.base_parameters import rational
from spelgen.structure.recursion import Position, energies

Value: TypeAlias = fmpq_mpoly | fmpq | int
"""A polynomial, or a number where nothing else is needed."""


class Deferred:
    """Hold an operation of the recursion that waits to be carried out, or a leaf of it."""

    __slots__ = ("action", "operands")

    def __init__(self, action: str, *operands: Deferred | Value):
        self.action = action
        self.operands = operands

    def __add__(self, operand: Deferred | int) -> Deferred:
        # zeros are common, and what is not written down need not be carried out
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
    """Tell that an expansion needs more multiplications of terms than its budget holds."""


class Budget:
    """Count how many multiplications of terms are left."""

    def __init__(self, left: int):
        self.left = left

    def spend(self, cost: int) -> None:
        """Take ``cost`` away. Raises TooLarge, before anything is computed, where less is left."""
        if cost > self.left:
            raise TooLarge
        self.left -= cost


class Expansion:
    """Hold the recursion of ``arm``, written down over s1, c1, q1, s2, ... three variables a coordinate."""

    def __init__(self, arm: Arm):
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
        self.written = energies(arm, positions, inertias, _number)

    def polynomial(self, element: Deferred | int, parameter: int, budget: Budget) -> fmpq_mpoly:
        """Return what ``parameter`` (10 body + i) is multiplied by in ``element``. Raises TooLarge."""
        values: dict[int, Value] = {}
        for index, leaf in enumerate(self._parameters):
            values[id(leaf)] = int(index == parameter)
        # a stack and no recursion: the operations of a long arm are nested deeper than Python may call
        stack = [element]
        while stack:
            node = stack[-1]
            missing = []
            if isinstance(node, Deferred) and id(node) not in values:
                missing = [x for x in node.operands if isinstance(x, Deferred) and id(x) not in values]
                if not missing:
                    values[id(node)] = _carried_out(node, values, budget)
            if missing:
                stack += missing
            else:
                stack.pop()
        return _value(element, values) + self.context.from_dict({})


def _carried_out(node: Deferred, values: dict[int, Value], budget: Budget) -> Value:
    if node.action == "constant":
        return _value(node.operands[0], values)
    x, y = (_value(operand, values) for operand in node.operands)
    if node.action == "add":
        return x + y
    if _is_zero(x) or _is_zero(y):
        return 0
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
