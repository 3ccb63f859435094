"""Friction of each joint by laws with trained constants."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from spelgen.runtime.bristles import Bristles
from spelgen.runtime.joints import Joints, vector

# where the constants start, relative to a joint's usual friction and speed
STRIBECK = 0.3  # dry friction that only slow motion has
STRIBECK_VELOCITY = 0.03  # where that has faded
STRIBECK_ROUNDING = (
    10.0  # by that velocity: above 1 the fall is nearly a Gaussian, far below it begins at rest
)
SMOOTHING_VELOCITY = 0.006  # over which dry friction turns around
# the same of joints whose friction has no memory though others' has: a wider turn looks like memory
SHARP_VELOCITY = 0.001
SATURATION_VELOCITY = 0.2  # where viscous friction begins to grow more slowly
LOAD_DEPENDENCE = 0.03  # dry friction by gravity torque
# below this fraction of usual friction a gravity torque's size is rounded off: at right angles it passes
# zero, where |x| has no derivative
LEAST_LOAD = 0.01


class FrictionConstants(NamedTuple):
    """By joint, (n,), all positive."""

    viscous: Tensor  # [Nm s/rad, N s/m]
    saturation: Tensor  # viscous friction that stops growing [Nm, N]
    saturation_velocity: Tensor  # [rad/s, m/s]
    coulomb: Tensor  # [Nm, N]
    stribeck: Tensor  # [Nm, N]
    stribeck_velocity: Tensor  # [rad/s, m/s]
    stribeck_rounding: Tensor  # by that velocity
    coulomb_smoothing_velocity: Tensor  # [rad/s, m/s]
    load_dependence: Tensor  # dry friction by gravity torque
    least_load: Tensor  # [Nm, N]
    bristle_fractions: Tensor  # of dry friction, (n, K); a joint's add up to one, or are zero
    memoryless: Tensor  # 1 where dry friction follows velocity alone, 0 where bristles


class FrictionLaws(nn.Module):
    """Friction which resists whatever the weights are: they are logarithms.

    viscous qd + saturation turned(qd, saturation_velocity)
    + (coulomb + stribeck / (1 + (1 + r) v^2 / (v + r) / 8)^8 + load_dependence load) direction, with
    v = |qd| / stribeck_velocity, r the rounding, load = sqrt(gravity torque^2 + least_load^2) and
    turned(x, width) = x / sqrt(x^2 + width^2).

    The direction, from -1 to 1, is that of the bristles, sum of fraction z / reach; at joints without
    memory, or where nothing is known of the way here, turned(qd, coulomb_smoothing_velocity).
    No law has an exponential: a control loop has them in a third of the time. The Stribeck effect is the
    nearly the Gaussian of Armstrong-Helouvry (Control of Machines with Friction, 1991) where r is large, and
    the exponential of Bo and Pavelescu (Wear 82:277, 1982), without its corner at rest, where it is small.
    """

    kinds = (
        ("raw_viscous", "sizes", "Nm s/rad, N s/m"),
        ("raw_saturation", "sizes", "Nm, N"),
        ("raw_saturation_velocity", "velocities", "rad/s, m/s"),
        ("raw_coulomb", "sizes", "Nm, N"),
        ("raw_stribeck", "sizes", "Nm, N"),
        ("raw_stribeck_velocity", "velocities", "rad/s, m/s"),
        ("raw_coulomb_smoothing_velocity", "velocities", "rad/s, m/s"),
        ("raw_load_dependence", "load_dependence", "1"),
        ("raw_bristle_fractions", "fractions", "1"),
    )

    nominal: Tensor
    speed: Tensor
    memoryless: Tensor
    stribeck_rounding: Tensor
    raw_coulomb_smoothing_velocity: nn.Parameter | None
    raw_bristle_fractions: nn.Parameter | None

    def __init__(self, joints: Joints, reach: Sequence[Sequence[float]] = ()) -> None:
        super().__init__()
        self.register_buffer("nominal", vector(joints.friction))
        self.register_buffer("speed", vector(joints.speed))
        self.bristles = Bristles(reach or [[]] * len(joints.speed))
        start = torch.zeros(len(joints.speed), dtype=torch.float64)
        # no parameter: a fit to torques compares both forms
        self.register_buffer("memoryless", torch.full_like(start, 0.0 if reach else 1.0))
        self.register_buffer("stribeck_rounding", torch.full_like(start, STRIBECK_ROUNDING))
        self.raw_viscous = nn.Parameter(start.clone())
        self.raw_saturation = nn.Parameter(start.clone())
        self.raw_saturation_velocity = nn.Parameter(start.clone())
        self.raw_coulomb = nn.Parameter(start.clone())
        self.raw_stribeck = nn.Parameter(start.clone())
        self.raw_stribeck_velocity = nn.Parameter(start.clone())
        self.raw_load_dependence = nn.Parameter(start.clone())
        # dry friction turns around by displacement or by velocity, never by both
        smoothing = None if reach else nn.Parameter(start.clone())
        self.register_parameter("raw_coulomb_smoothing_velocity", smoothing)
        fractions = nn.Parameter(torch.zeros_like(self.bristles.reach)) if reach else None
        self.register_parameter("raw_bristle_fractions", fractions)

    @property
    def sharp_velocity(self) -> Tensor:
        """Over which dry friction turns around, (n,), where a joint has no memory though others have."""
        return SHARP_VELOCITY * self.speed

    def prepare(self) -> FrictionConstants:
        """The constants, in their units."""
        size, speed = self.nominal, self.speed
        smoothing, fractions = self.raw_coulomb_smoothing_velocity, self.raw_bristle_fractions
        return FrictionConstants(
            viscous=size / speed * self.raw_viscous.exp(),
            saturation=size * self.raw_saturation.exp(),
            saturation_velocity=SATURATION_VELOCITY * speed * self.raw_saturation_velocity.exp(),
            coulomb=size * self.raw_coulomb.exp(),
            stribeck=STRIBECK * size * self.raw_stribeck.exp(),
            stribeck_velocity=STRIBECK_VELOCITY * speed * self.raw_stribeck_velocity.exp(),
            stribeck_rounding=self.stribeck_rounding,
            coulomb_smoothing_velocity=self.sharp_velocity
            if smoothing is None
            else SMOOTHING_VELOCITY * speed * smoothing.exp(),
            load_dependence=LOAD_DEPENDENCE * size.sign() * self.raw_load_dependence.exp(),
            least_load=LEAST_LOAD * torch.where(size > 0, size, 1.0),
            bristle_fractions=self.bristles.reach if fractions is None else self._remembered(fractions),
            memoryless=self.memoryless,
        )

    def _remembered(self, fractions: Tensor) -> Tensor:
        return fractions.softmax(dim=-1) * (1 - self.memoryless).unsqueeze(-1)

    def resistance(self, qd: Tensor, gravity: Tensor, constants: FrictionConstants) -> Tensor:
        """The diagonal of D, (..., n): friction torque by velocity, of joints that slide."""
        c = constants
        slope = torch.rsqrt(qd * qd + c.coulomb_smoothing_velocity**2)
        return self.viscosity(qd, c) + self.dry(qd, gravity, c) * slope

    def forward(
        self,
        qd: Tensor,
        gravity: Tensor,
        constants: FrictionConstants,
        z: Tensor | None = None,
        direction: Tensor | None = None,
    ) -> Tensor:
        """The friction torque, (..., n) [Nm, N], under this gravity torque, of bristles at z, (..., n, K).

        z: None where nothing is known of the way here; all joints are then without memory.
        direction: (..., n) of joints without memory; None: that of qd.
        """
        c = constants
        if direction is None:
            direction = turned(qd, c.coulomb_smoothing_velocity)
        if z is not None:
            bent = (c.bristle_fractions / self.bristles.reach * z).sum(dim=-1)
            direction = bent + c.memoryless * direction
        return self.viscosity(qd, c) * qd + self.dry(qd, gravity, c) * direction

    def sliding(self, qd: Tensor) -> Tensor:
        """The bristles z, (..., n, K), of joints that have long gone this way.

        Near the smoothing velocity they bear up to 7.4 % more than friction without z, far above it the same.
        """
        # bent as far as they go a few widths on: the rest of an algebraic turn would be a stiff transient
        direction = (qd / self.prepare().coulomb_smoothing_velocity).tanh()
        return direction.unsqueeze(-1) * self.bristles.reach

    def stored_energy(self, z: Tensor, constants: FrictionConstants) -> Tensor:
        """What the bristles of Coulomb friction give back, (...) [J]."""
        stored = constants.bristle_fractions * z.square() / self.bristles.reach
        return 0.5 * (constants.coulomb * stored.sum(dim=-1)).sum(dim=-1)

    @staticmethod
    def viscosity(qd: Tensor, c: FrictionConstants) -> Tensor:
        """Torque by velocity, (..., n)."""
        return c.viscous + c.saturation * torch.rsqrt(qd * qd + c.saturation_velocity**2)

    @staticmethod
    def dry(qd: Tensor, gravity: Tensor, c: FrictionConstants) -> Tensor:
        """The size of dry friction, (..., n) [Nm, N]."""
        speed = qd.abs() / c.stribeck_velocity
        rounding = c.stribeck_rounding
        slow = 1 / (1 + (1 + rounding) / 8 * speed.square() / (speed + rounding))
        slow = slow.square().square().square()  # a power of 8 takes twice the time
        load = (gravity.square() + c.least_load**2).sqrt()
        return c.coulomb + c.stribeck * slow + c.load_dependence * load


def turned(velocity: Tensor, width: Tensor) -> Tensor:
    """A direction from -1 to 1 that turns around over this width of velocities, (..., n)."""
    return velocity * torch.rsqrt(velocity * velocity + width**2)
