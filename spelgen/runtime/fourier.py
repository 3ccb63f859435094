"""Fourier series of joint angles, with powers of prismatic joints: what a rigid arm's functions are."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from spelgen.runtime.joints import Joints, vector


class Term(NamedTuple):
    """x^powers (cos_factor cos(frequencies q) + sin_factor sin(frequencies q)), x the scaled q."""

    frequencies: tuple[int, ...]  # by joint
    powers: tuple[int, ...]  # by joint; none where no joint is prismatic
    cos_factor: float
    sin_factor: float


class FourierFeatures(nn.Module):
    """x^powers cos(frequencies q), then x^powers sin(frequencies q), (..., 2 K), of all terms of ``series``.

    With every power its lower powers are there too, for the derivatives.
    """

    frequencies: Tensor  # (n, K)
    powers: Tensor  # (K, n)
    lower: Tensor  # takes K features to their derivatives by each joint that slides, (K, n K)

    def __init__(self, joints: Joints, series: Iterable[Sequence[Term]]) -> None:
        super().__init__()
        still = (0,) * joints.n
        keys = {(term.frequencies, term.powers or still) for terms in series for term in terms}
        waiting = list(keys)
        while waiting:
            frequencies, powers = waiting.pop()
            below = {(frequencies, _less(powers, joint)) for joint, power in enumerate(powers) if power}
            waiting += below - keys
            keys |= below
        self.keys = sorted(keys)
        self.count, self.joints = len(keys), joints.n
        self.prismatic = any(any(powers) for _, powers in keys)
        self.register_buffer("frequencies", torch.stack([vector(each) for each, _ in self.keys]).mT)
        self.register_buffer("powers", torch.stack([vector(each) for _, each in self.keys]))
        lower = torch.zeros(self.count, joints.n, self.count, dtype=torch.float64)
        for place, (frequencies, powers) in enumerate(self.keys):
            for joint, power in enumerate(powers):
                if power:
                    below_place = self.keys.index((frequencies, _less(powers, joint)))
                    lower[below_place, joint, place] = power / joints.reach[joint]
        self.register_buffer("lower", lower.flatten(1))

    def place(self, term: Term) -> int:
        """Where a term's cosine stands among the features."""
        return self.keys.index((term.frequencies, term.powers or (0,) * self.joints))

    def forward(self, q: Tensor, scaled: Tensor) -> Tensor:
        """The features of q, with the scaled q at hand."""
        angle = q @ self.frequencies
        cos, sin = angle.cos(), angle.sin()
        if self.prismatic:
            size = (scaled.unsqueeze(-2) ** self.powers).prod(dim=-1)
            cos, sin = size * cos, size * sin
        return torch.cat([cos, sin], dim=-1)

    def _by_sliding(self, feature: Tensor) -> Tensor:
        """d/dq of K features by prismatic joints, (..., n, K)."""
        return (feature @ self.lower).reshape(*feature.shape[:-1], self.joints, self.count)

    def jvp(self, features: Tensor, qd: Tensor) -> Tensor:
        """How fast the features change along qd."""
        cos, sin = features.chunk(2, dim=-1)
        turned = qd @ self.frequencies
        by_cos, by_sin = -sin * turned, cos * turned
        if self.prismatic:
            slid = [(qd.unsqueeze(-2) @ self._by_sliding(x)).squeeze(-2) for x in (cos, sin)]
            by_cos, by_sin = slid[0] + by_cos, slid[1] + by_sin
        return torch.cat([by_cos, by_sin], dim=-1)

    def vjp(self, features: Tensor, cotangent: Tensor) -> Tensor:
        """d/dq, (..., n), of what has the derivative ``cotangent`` by the features."""
        cos, sin = features.chunk(2, dim=-1)
        by_cos, by_sin = cotangent.chunk(2, dim=-1)
        by_joint = (by_sin * cos - by_cos * sin) @ self.frequencies.mT
        if self.prismatic:
            for feature, by_feature in ((cos, by_cos), (sin, by_sin)):
                slid = self._by_sliding(feature) @ by_feature.unsqueeze(-1)
                by_joint = by_joint + slid.squeeze(-1)
        return by_joint

    def gradient_map(self, coefficients: Tensor) -> Tensor:
        """What takes the features to d/dq of features @ coefficients, (2 K, n)."""
        by_cos, by_sin = coefficients.unsqueeze(-1).chunk(2)
        turned = torch.cat([by_sin * self.frequencies.mT, -by_cos * self.frequencies.mT])
        if not self.prismatic:
            return turned
        lower = self.lower.reshape(self.count, self.joints, self.count)
        return turned + torch.cat([lower @ by_cos, lower @ by_sin]).squeeze(-1)


class FourierSeries(nn.Module):
    """Fourier series with trained coefficients, one for each output of a network beside it.

    ``series`` has, for each output, the terms that coefficients start from. They are trained in
    units of the output's scale times the least sensitivity of the joints that the term depends on.
    """

    outputs: Tensor  # of each coefficient
    places: Tensor
    units: Tensor

    def __init__(
        self,
        features: FourierFeatures,
        series: Sequence[Sequence[Term]],
        scales: Sequence[float],
        sensitivity: Sequence[float],
    ) -> None:
        super().__init__()
        self.count = features.count
        moving = (features.frequencies.mT != 0) | (features.powers != 0)  # (K, n)
        rows = []
        for output, (terms, scale) in enumerate(zip(series, scales, strict=True)):
            for term in terms:
                place = features.place(term)
                unit = min(s for s, moves in zip(sensitivity, moving[place], strict=True) if moves)
                rows.append((output, place, term.cos_factor / scale / unit, unit))
                rows.append((output, features.count + place, term.sin_factor / scale / unit, unit))
        outputs, places, starts, units = zip(*rows, strict=True)
        self.register_buffer("outputs", torch.tensor(outputs))
        self.register_buffer("places", torch.tensor(places))
        self.register_buffer("units", vector(units))
        self.raw_coefficients = nn.Parameter(vector(starts))

    def prepare(self, output_map: Tensor) -> Tensor:
        """What takes features to output_map y, (rows, 2 K), where y are the series."""
        known = output_map.new_zeros(output_map.shape[1], 2 * self.count)
        coefficients = self.units * self.raw_coefficients
        return output_map @ known.index_put((self.outputs, self.places), coefficients)


def _less(powers: tuple[int, ...], joint: int) -> tuple[int, ...]:
    """The powers with one less of a joint."""
    return tuple(power - (k == joint) for k, power in enumerate(powers))
