"""Products of cosines and sines as sums of multiple angles."""

from __future__ import annotations

from collections.abc import Mapping
from fractions import Fraction

from spelgen.formulas.expression import Trig

_Spectrum = dict[tuple[int, ...], tuple[Fraction, Fraction]]
"""Real and imaginary part of what exp(i k.q) is multiplied by, by k."""


def harmonics(
    powers: Mapping[int, tuple[int, int]], units: Mapping[int, Fraction]
) -> list[tuple[Trig | None, Fraction]]:
    """A product of powers of (cosine, sine), by coordinate, as a sum; None stands for the constant.

    ``units`` says which fraction of each coordinate the cosines and sines are of.
    """
    found: list[tuple[Trig | None, Fraction]] = []
    for harmonic, (re, im) in _spectrum(powers).items():
        if not any(harmonic):
            found += [(None, re)] if re else []
        elif next(x for x in harmonic if x) > 0:
            # the harmonic and its conjugate, at minus the angle, add up
            angle = tuple((k, x * units[k]) for k, x in zip(powers, harmonic, strict=True) if x)
            found += [(Trig("cos", angle), 2 * re)] if re else []
            found += [(Trig("sin", angle), -2 * im)] if im else []
    return found


def _spectrum(powers: Mapping[int, tuple[int, int]]) -> _Spectrum:
    """The product, factor by factor: cos = (e + 1/e) / 2 and sin = (e - 1/e) / 2i, with e = exp(iq)."""
    spectrum: _Spectrum = {(0,) * len(powers): (Fraction(1), Fraction(0))}
    half = Fraction(1, 2)
    for place, (cosines, sines) in enumerate(powers.values()):
        for is_sine in [False] * cosines + [True] * sines:
            product: _Spectrum = {}
            for harmonic, (re, im) in spectrum.items():
                for step in (1, -1):
                    a, b = (step * im * half, -step * re * half) if is_sine else (re * half, im * half)
                    key = (*harmonic[:place], harmonic[place] + step, *harmonic[place + 1 :])
                    x, y = product.get(key, (Fraction(0), Fraction(0)))
                    product[key] = (x + a, y + b)
            spectrum = product
    return spectrum
