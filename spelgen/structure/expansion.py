"""Entries of M, and V, as exact polynomials in the sines, cosines and positions of the joints.

The recursion of ``structure.recursion`` for M and V runs once and records its additions and multiplications, without
executing them: each entry of M, and V, becomes a tree of operations. M and V are linear in the inertial parameters. If
the tree of an entry is executed with one inertial parameter set to 1 and all others to 0, the result is therefore the
coefficient of this parameter in the entry: a polynomial. Only requested entries are expanded, memory is limited to the
polynomials of one inertial parameter, and an expansion is stopped before it exceeds its budget of multiplications.
"""

from __future__ import annotations

from typing import TypeAlias

from flint import Ordering, fmpq, fmpq_mpoly, fmpq_mpoly_ctx

from spelgen.arm.arm import Chain
from spelgen.structure.base_parameters import rational
from spelgen.structure.recursion import Position, energies

Value: TypeAlias = fmpq_mpoly | fmpq | int
"""The value of a recorded operation: a polynomial, or a number."""


class Deferred:
    """A recorded operation of the recursion for M and V: a node of an expression tree.

    Attributes:
        action: ``add`` or ``multiply``; or, for a leaf, ``constant`` or ``parameter`` (an inertial parameter).
        operands: operands of the operation; the value of a constant; the index of an inertial parameter.
    """

    __slots__ = ("action", "operands")

    def __init__(self, action: str, *operands: Deferred | Value):
        self.action = action
        self.operands = operands

    def __add__(self, operand: Deferred | int) -> Deferred:
        # Zeros are frequent: a sum with zero is not recorded, so that its execution takes no time.
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
    """Error: the polynomial of V or of an entry of M needs more multiplications of terms than `Expansion` permits."""


class Expansion:
    """M and V of ``arm`` as recorded operations, from which polynomials in s1, c1, q1, s2, ... are computed.

    M is the mass matrix, V the potential energy; an operation is recorded as a `Deferred`. s, c and q with a number are
    sine, cosine and position of the coordinate with this number, from 1 (``Position``).

    Args:
        arm: the arm.
        budget: number of multiplications of polynomial terms that all calls of ``polynomial`` together may use; 2e6
            take about 2 s.

    Attributes:
        energies: recorded operations of the entries of M, and of V.
        context: polynomial ring of FLINT.
    """

    def __init__(self, arm: Chain, budget: int = 2_000_000):
        names: list[str] = []
        for k in range(1, len(arm.coordinates) + 1):
            names += (f"s{k}", f"c{k}", f"q{k}")
        self.budget = budget
        self.context = fmpq_mpoly_ctx.get(names, Ordering.lex)
        variables = [Deferred("constant", x) for x in self.context.gens()]
        self._parameters = [Deferred("parameter", index) for index in range(10 * len(arm.bodies))]
        positions = list(map(Position, variables[1::3], variables[::3], variables[2::3]))
        inertias = []
        for first in range(0, len(self._parameters), 10):
            inertias.append(self._parameters[first : first + 10])
        self.energies = energies(
            arm, positions, inertias, lambda value: Deferred("constant", rational(value))
        )

    def polynomial(self, element: Deferred | int, parameter: int) -> fmpq_mpoly:
        """Return the coefficient of one inertial parameter in an entry of M, or in the potential energy V.

        M and V are linear in the inertial parameters. The coefficient is a polynomial in s1, c1, q1, s2, ...: sines,
        cosines and positions of the joints (see the class).

        Args:
            element: the entry of M, or V, as recorded operations from ``energies``; the integer 0 for a zero entry.
            parameter: index of the inertial parameter: 10 k + i for parameter i of body k, both from 0.

        Raises:
            TooLarge: the polynomials need more multiplications than ``budget``.
        """
        # The keys of `values` are the id() of recorded operations: a subexpression that occurs twice is computed once.
        values: dict[int, Value] = {}
        for index, leaf in enumerate(self._parameters):
            values[id(leaf)] = int(index == parameter)
        # A stack replaces recursion: recorded operations of long arms are nested deeper than Python's recursion limit.
        stack = [element]
        while stack:
            node = stack[-1]
            missing = []
            if isinstance(node, Deferred) and id(node) not in values:
                missing = [x for x in node.operands if isinstance(x, Deferred) and id(x) not in values]
                if not missing:
                    operands = [_value(operand, values) for operand in node.operands]
                    values[id(node)] = self._executed(node.action, *operands)
            if missing:
                stack += missing
            else:
                stack.pop()
        return _value(element, values) + self.context.from_dict({})

    def _executed(self, action: str, x: Value, y: Value = 0) -> Value:
        if action == "constant":
            return x
        if action == "add":
            return x + y
        # The cost of a multiplication is the number of products of two polynomial terms: FLINT computes all of them
        # before it collects like terms. A product with 0 costs nothing; all inertial parameters except for one have the
        # value 0.
        cost = 1
        for factor in (x, y):
            if isinstance(factor, fmpq_mpoly):
                cost *= max(1, len(factor))
            elif factor == 0:
                return 0
        if cost > self.budget:
            raise TooLarge
        self.budget -= cost
        return x * y


def _value(operand: Deferred | Value, values: dict[int, Value]) -> Value:
    return values[id(operand)] if isinstance(operand, Deferred) else operand
