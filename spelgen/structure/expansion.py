"""Entries of M, and V, as exact polynomials for one inertial parameter at a time, within a budget.

The recursion is run once over operations that are only written down; what an entry needs is then carried
out, for one parameter set to 1 and all others to 0. So nothing is expanded that was not asked for, memory
stays that of one parameter's polynomials, and an expansion that would take too long stops before it does.
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from typing import Any

from flint import Ordering, fmpq, fmpq_mpoly, fmpq_mpoly_ctx

from spelgen.arm.arm import Arm
from spelgen.structure.recursion import energies
from spelgen.structure.sampling import Position, motions

Value = Any
"""A polynomial, or a number where nothing else is needed."""


class Deferred:
    """An operation of the recursion that waits to be carried out, or a leaf of it."""

    __slots__ = ("action", "parts")

    def __init__(self, action: str, *parts: Any):
        self.action = action
        self.parts = parts

    def __add__(self, other: Deferred | int) -> Deferred:
        return self if isinstance(other, int) and other == 0 else Deferred("add", self, other)

    __radd__ = __add__

    def __neg__(self) -> Deferred:
        return Deferred("multiply", self, -1)

    def __sub__(self, other: Deferred | int) -> Deferred:
        return self + -other

    def __rsub__(self, other: int) -> Deferred:
        return -self + other

    def __mul__(self, other: Deferred | int) -> Deferred | int:
        if isinstance(other, int) and other in (0, 1):
            return self if other else 0
        return Deferred("multiply", self, other)

    __rmul__ = __mul__


class TooLarge(Exception):
    """An expansion needs more multiplications of terms than its budget holds."""


class Budget:
    """How many multiplications of terms are left."""

    def __init__(self, left: int):
        self.left = left

    def spend(self, cost: int) -> None:
        """Take ``cost`` away. Raises TooLarge, before anything is computed, where less is left."""
        if cost > self.left:
            raise TooLarge
        self.left -= cost


class Expansion:
    """The recursion of ``arm``, written down over c1, s1, q1, c2, ... three variables a coordinate."""

    def __init__(self, arm: Arm):
        n = len(arm.coordinates)
        names = [f"{letter}{k + 1}" for k in range(n) for letter in "csq"]
        self.context = fmpq_mpoly_ctx.get(names, Ordering.lex)
        variables = [Deferred("constant", x) for x in self.context.gens()]
        self._parameters = [Deferred("parameter", index) for index in range(10 * len(arm.bodies))]
        positions = [Position(*variables[3 * k : 3 * k + 3]) for k in range(n)]
        inertias: list[Sequence[Deferred]] = [
            self._parameters[10 * body : 10 * body + 10] for body in range(len(arm.bodies))
        ]
        self.written = energies(arm, motions(arm, positions, _number), inertias, _number)

    def polynomial(self, element: Deferred | int, parameter: int, budget: Budget) -> fmpq_mpoly:
        """What ``parameter`` (10 body + i) is multiplied by in ``element``. Raises TooLarge."""
        known: dict[int, Value] = {
            id(leaf): int(index == parameter) for index, leaf in enumerate(self._parameters)
        }
        waiting = [element] if isinstance(element, Deferred) else []
        while waiting:
            at = waiting[-1]
            missing = [part for part in at.parts if isinstance(part, Deferred) and id(part) not in known]
            if id(at) in known or not missing:
                waiting.pop()
                known.setdefault(id(at), _carried_out(at, known, budget))
            waiting += missing
        return _value(element, known) + 0 * self.context.gens()[0]


def _carried_out(node: Deferred, known: dict[int, Value], budget: Budget) -> Value:
    if node.action == "constant":
        return node.parts[0]
    if node.action == "parameter":
        return known[id(node)]
    x, y = (_value(part, known) for part in node.parts)
    if node.action == "add":
        return x + y
    if _is_zero(x) or _is_zero(y):
        return 0
    budget.spend(_terms(x) * _terms(y))
    return x * y


def _value(part: Deferred | int, known: dict[int, Value]) -> Value:
    return known[id(part)] if isinstance(part, Deferred) else part


def _is_zero(value: Value) -> bool:
    return isinstance(value, int) and value == 0


def _terms(value: Value) -> int:
    return max(1, len(value)) if isinstance(value, fmpq_mpoly) else 1


def _number(value: Fraction) -> Deferred:
    return Deferred("constant", fmpq(value.numerator, value.denominator))
