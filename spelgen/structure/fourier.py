"""Every function that M and V are made of as a finite Fourier series: what a rigid arm leaves of it is numbers.

A revolute joint's angle enters M as cosine and sine to the second degree at most, a prismatic joint's distance
as a polynomial of the second degree. So a function of few joints is

    f(q) = offset + sum over terms of  x^powers (a cos(frequencies q) + b sin(frequencies q))

with whole numbers ``frequencies`` between -2 and 2 and x the scaled distances. Which terms occur follows from the
kinematics: they are those that a discrete Fourier transform finds for random inertial parameters.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from math import prod

import numpy as np

from spelgen.arm.arm import Arm
from spelgen.structure.basis import Weights
from spelgen.structure.nominal import working_range
from spelgen.structure.recursion import triangle
from spelgen.structure.sampling import Ten, float_energies
from spelgen.structure.structure import Structure

MOST_TERMS = 48
"""M or V is left to networks alone where it takes more."""
_MOST_POINTS = 5**5
_GRIDS = {"revolute": 2 * np.pi / 5 * np.arange(5), "prismatic": np.array([-1.0, 0.0, 1.0])}
_DRAWS = 2
_NOTHING = 1e-9  # relative to a function's largest coefficient
_DIGITS = 9

Coefficients = dict["FourierTerm", tuple[float, float]]


@dataclass(frozen=True)
class FourierTerm:
    """x^powers cos(frequencies q) and x^powers sin(frequencies q); both by coordinate."""

    frequencies: tuple[int, ...]
    powers: tuple[int, ...]


@dataclass(frozen=True)
class FourierSeries:
    """offset + sum over ``terms`` of x^powers (a cos + b sin), each (place in FourierExpansion.terms, a, b)."""

    offset: float
    terms: tuple[tuple[int, float, float], ...]


@dataclass(frozen=True)
class FourierExpansion:
    """The ``terms`` of an arm, with every power's lower powers. outputs, potential: the structure's outputs
    and V as series with nominal coefficients; None for what takes too many terms. V has no offset: only its
    changes matter.
    """

    terms: tuple[FourierTerm, ...]
    outputs: tuple[FourierSeries, ...] | None
    potential: FourierSeries | None


NO_SERIES = FourierExpansion((), None, None)


def fourier_expansion(arm: Arm, structure: Structure, inertias: Sequence[Ten]) -> FourierExpansion:
    """The Fourier series of the structure's functions; coefficients are those that ``inertias`` give.

    None are found for arms with mimic joints, which turn by fractions of an angle.
    """
    outputs = _coefficients(
        arm, structure, inertias, [(each.joints, each.reads) for each in structure.outputs]
    )
    v = [(structure.potential, None)] if structure.potential else []
    potential = _coefficients(arm, structure, inertias, v) or None
    constant = _constant(len(arm.coordinates))
    chosen = {term for each in (*(outputs or ()), *(potential or ())) for term in each} - {constant}
    if any(any(term.powers) for term in chosen):
        chosen.add(constant)
    terms = sorted(chosen, key=lambda term: (term.powers, term.frequencies))
    places = {term: place for place, term in enumerate(terms)}

    def series(found: Coefficients) -> FourierSeries:
        rows = sorted((places[term], *found[term]) for term in found if term != constant)
        return FourierSeries(found.get(constant, (0.0, 0.0))[0], tuple(rows))

    return FourierExpansion(
        tuple(terms),
        None if outputs is None else tuple(series(each) for each in outputs),
        None if potential is None else replace(series(potential[0]), offset=0.0),
    )


def _constant(n: int) -> FourierTerm:
    return FourierTerm((0,) * n, (0,) * n)


def _coefficients(
    arm: Arm,
    structure: Structure,
    inertias: Sequence[Ten],
    functions: Sequence[tuple[tuple[int, ...], Weights | None]],
) -> list[Coefficients] | None:
    """The terms of functions of (joints, weights of M's entries, or None for V), with their coefficients;
    None where there are too many.
    """
    plain = [body.coordinate for body in arm.bodies] == list(range(len(arm.coordinates)))
    if not plain or any(body.multiplier != 1 or body.offset for body in arm.bodies):
        return None
    if any(_points(arm, joints) > _MOST_POINTS for joints, _ in functions):
        return None
    rng = np.random.default_rng(0)
    drawn: list[Sequence[Ten]] = [inertias]
    if structure.assume == "kinematics":
        drawn = [[list(rng.normal(size=10)) for _ in arm.bodies] for _ in range(_DRAWS)]
    found: list[Coefficients] = []
    for joints, reads in functions:
        occurring = np.any([_occurring(_spectrum(arm, joints, reads, each)) for each in drawn], axis=0)
        nominal = _spectrum(arm, joints, reads, inertias)
        found.append(_folded(arm, joints, nominal, occurring))
    constant = _constant(len(arm.coordinates))
    return found if len({term for each in found for term in each} - {constant}) <= MOST_TERMS else None


def _points(arm: Arm, joints: Sequence[int]) -> int:
    return prod(len(_GRIDS[arm.coordinates[joint].kind]) for joint in joints)


def _spectrum(arm: Arm, joints: Sequence[int], reads: Weights | None, inertias: Sequence[Ten]) -> np.ndarray:
    """Complex coefficients of a function, an axis for each of its joints: by frequencies 0, 1, 2, -2,
    -1, or by power.
    """
    kinds = [arm.coordinates[joint].kind for joint in joints]
    grids = [_GRIDS[kind] for kind in kinds]
    q = np.zeros((_points(arm, joints), len(arm.coordinates)))
    for joint, kind, values in zip(joints, kinds, np.meshgrid(*grids, indexing="ij"), strict=True):
        low, high = working_range(arm.coordinates[joint])
        scaled = (low + high) / 2 + (high - low) / 2 * values
        q[:, joint] = (values if kind == "revolute" else scaled).ravel()
    mass, potential = float_energies(arm, q, inertias)
    if reads is None:
        sampled = potential
    else:
        keys = triangle(len(arm.coordinates))
        sampled = np.sum([float(value) * mass[:, keys.index((i, j))] for i, j, value in reads], axis=0)
    spectrum = sampled.reshape([len(grid) for grid in grids]).astype(complex)
    powers = np.linalg.inv(np.vander(_GRIDS["prismatic"], increasing=True))
    for axis, kind in enumerate(kinds):
        if kind == "revolute":
            spectrum = np.fft.fft(spectrum, axis=axis, norm="forward")
        else:
            spectrum = np.moveaxis(np.tensordot(powers, spectrum, axes=(1, axis)), 0, axis)
    return spectrum


def _occurring(spectrum: np.ndarray) -> np.ndarray:
    size = np.abs(spectrum)
    return size > _NOTHING * size.max(initial=0.0)


def _folded(arm: Arm, joints: Sequence[int], spectrum: np.ndarray, occurring: np.ndarray) -> Coefficients:
    """Term -> (a, b). Frequencies and their opposites are one term; with a power come the lower ones, which
    another origin of the distance would bring in.
    """
    n = len(arm.coordinates)
    found: Coefficients = {}
    for place in zip(*np.nonzero(occurring), strict=True):
        frequencies, powers = [0] * n, [0] * n
        for joint, index in zip(joints, place, strict=True):
            if arm.coordinates[joint].kind == "revolute":
                frequencies[joint] = int(index) if index <= 2 else int(index) - 5
            else:
                powers[joint] = int(index)
        if next((each for each in frequencies if each), 0) < 0:
            continue  # its opposite is there too
        value = spectrum[place] * (2 if any(frequencies) else 1)
        found[FourierTerm(tuple(frequencies), tuple(powers))] = (_rounded(value.real), _rounded(-value.imag))
    for term in list(found):
        for lower in product(*(range(power + 1) for power in term.powers)):
            found.setdefault(FourierTerm(term.frequencies, lower), (0.0, 0.0))
    return found


def _rounded(value: float) -> float:
    """To nine digits, so that it is the same on every machine."""
    return 0.0 if abs(value) < 1e-9 else float(f"{value:.{_DIGITS}g}")
