"""Friction of each joint by laws with trained constants."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from spelgen.runtime.joints import Joints, vector

# where the constants start, relative to a joint's usual friction and speed
STRIBECK = 0.3  # dry friction that only slow motion has
STRIBECK_VELOCITY = 0.03  # where that has faded
SMOOTHING_VELOCITY = 0.006  # over which dry friction turns around
SATURATION_VELOCITY = 0.2  # where viscous friction begins to grow more slowly
LOAD_DEPENDENCE = 0.03  # dry friction by gravity torque


class FrictionConstants(NamedTuple):
    """By joint, (n,), all positive."""

    viscous: Tensor  # [Nm s/rad, N s/m]
    saturation: Tensor  # viscous friction that stops growing [Nm, N]
    saturation_velocity: Tensor  # [rad/s, m/s]
    coulomb: Tensor  # [Nm, N]
    stribeck: Tensor  # [Nm, N]
    stribeck_velocity: Tensor  # [rad/s, m/s]
    coulomb_smoothing_velocity: Tensor  # [rad/s, m/s]
    load_dependence: Tensor  # dry friction by gravity torque


class FrictionLaws(nn.Module):
    """Friction which resists whatever the weights are: they are logarithms.

    viscous qd + saturation tanh(qd / saturation_velocity)
    + (coulomb + stribeck exp(-(qd / stribeck_velocity)^2) + load_dependence |gravity torque|)
    tanh(qd / coulomb_smoothing_velocity).
    """

    nominal: Tensor
    speed: Tensor

    def __init__(self, joints: Joints) -> None:
        super().__init__()
        self.register_buffer("nominal", vector(joints.friction))
        self.register_buffer("speed", vector(joints.speed))
        start = torch.zeros(joints.n, dtype=torch.float64)
        self.raw_viscous = nn.Parameter(start.clone())
        self.raw_saturation = nn.Parameter(start.clone())
        self.raw_saturation_velocity = nn.Parameter(start.clone())
        self.raw_coulomb = nn.Parameter(start.clone())
        self.raw_stribeck = nn.Parameter(start.clone())
        self.raw_stribeck_velocity = nn.Parameter(start.clone())
        self.raw_coulomb_smoothing_velocity = nn.Parameter(start.clone())
        self.raw_load_dependence = nn.Parameter(start.clone())

    def prepare(self) -> FrictionConstants:
        """The constants, in their units."""
        size, speed = self.nominal, self.speed
        return FrictionConstants(
            viscous=size / speed * self.raw_viscous.exp(),
            saturation=size * self.raw_saturation.exp(),
            saturation_velocity=SATURATION_VELOCITY * speed * self.raw_saturation_velocity.exp(),
            coulomb=size * self.raw_coulomb.exp(),
            stribeck=STRIBECK * size * self.raw_stribeck.exp(),
            stribeck_velocity=STRIBECK_VELOCITY * speed * self.raw_stribeck_velocity.exp(),
            coulomb_smoothing_velocity=SMOOTHING_VELOCITY * speed * self.raw_coulomb_smoothing_velocity.exp(),
            load_dependence=LOAD_DEPENDENCE * size.sign() * self.raw_load_dependence.exp(),
        )

    def resistance(self, qd: Tensor, gravity: Tensor, constants: FrictionConstants) -> Tensor:
        """The diagonal of D, (..., n): friction torque by velocity, under this gravity torque."""
        c = constants
        slow = (-((qd / c.stribeck_velocity) ** 2)).exp()
        dry = c.coulomb + c.stribeck * slow + c.load_dependence * gravity.abs()
        dry = dry / c.coulomb_smoothing_velocity * tanh_ratio(qd / c.coulomb_smoothing_velocity)
        saturating = c.saturation / c.saturation_velocity * tanh_ratio(qd / c.saturation_velocity)
        return c.viscous + saturating + dry

    def forward(self, qd: Tensor, gravity: Tensor, constants: FrictionConstants) -> Tensor:
        """The friction torque D qd, (..., n) [Nm, N], under this gravity torque."""
        return self.resistance(qd, gravity, constants) * qd


def tanh_ratio(x: Tensor) -> Tensor:
    """tanh(x) / x."""
    near = x.abs() < 1e-4
    safe = torch.where(near, torch.ones_like(x), x)
    return torch.where(near, 1 - x**2 / 3, safe.tanh() / safe)
