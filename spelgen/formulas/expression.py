"""Sums of products of base parameters, cosines, sines and sliding distances, and how long they are to read."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from fractions import Fraction
from typing import Literal

Angle = tuple[tuple[int, Fraction], ...]
"""A sum of coordinates: (index, multiple), by index."""


@dataclass(frozen=True)
class Symbol:
    """A base parameter."""

    name: str


@dataclass(frozen=True)
class Slide:
    """The position of a sliding joint."""

    joint: int


@dataclass(frozen=True)
class Trig:
    """The cosine or sine of an angle."""

    function: Literal["cos", "sin"]
    angle: Angle


@dataclass(frozen=True)
class Sum:
    """The sum of its terms; 0 without any."""

    terms: tuple[Term, ...]

    @property
    def cost(self) -> float:
        """How long it is to read, about one for every symbol."""
        return sum(term.cost for term in self.terms)

    def times(self, number: Fraction) -> Sum:
        """The sum with every term times ``number``."""
        return Sum(tuple(term.times(number) for term in self.terms))


Factor = Symbol | Slide | Trig | Sum


@dataclass(frozen=True)
class Term:
    """A number times powers of factors."""

    coefficient: Fraction
    factors: tuple[tuple[Factor, int], ...] = ()

    @property
    def cost(self) -> float:
        """How long it is to read."""
        number = 0.0 if abs(self.coefficient) == 1 and self.factors else 0.7
        return 0.3 + number + sum(_cost(factor) + 0.3 * (power > 1) for factor, power in self.factors)

    def times(self, number: Fraction, *factors: tuple[Factor, int]) -> Term:
        """The term times ``number`` and ``factors``, which are written first."""
        return Term(number * self.coefficient, (*factors, *self.factors))


def ordered(factors: Iterable[tuple[Factor, int]]) -> tuple[tuple[Factor, int], ...]:
    """The factors as they are written: parameters, then distances and angles by joint, then sums."""
    return tuple(sorted(factors, key=_place))


def _place(power: tuple[Factor, int]) -> tuple[int, int, bool]:
    factor, _ = power
    if isinstance(factor, Symbol):
        return 0, 0, False
    if isinstance(factor, Sum):
        return 2, 0, False
    return (1, factor.joint, False) if isinstance(factor, Slide) else (1, factor.angle[0][0], True)


def _cost(factor: Factor) -> float:
    if isinstance(factor, Sum):
        return 0.3 + factor.cost
    if isinstance(factor, Trig):
        return 0.5 + sum(0.5 if abs(multiple) == 1 else 0.75 for _, multiple in factor.angle)
    return 1.0
