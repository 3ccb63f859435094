"""Friction of each joint by laws with trained constants."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from spelgen.runtime.joints import vector
from spelgen.runtime.parts import Row, Rows

# over which dry friction turns around without memory, by usual velocity: a wider turn looks like memory
SHARP_VELOCITY = 0.001
# below this fraction of usual friction a gravity torque's size is rounded off: at right angles it passes
# zero, where |x| has no derivative
LEAST_LOAD = 0.01


class FrictionConstants(NamedTuple):
    """By joint, (n,), all positive."""

    viscous: Tensor  # [Nm s/rad, N s/m]
    saturation: Tensor  # viscous friction that stops growing [Nm, N]
    saturation_velocity: Tensor  # where it begins to [rad/s, m/s]
    coulomb: Tensor  # [Nm, N]
    stribeck: Tensor  # dry friction that only slow motion has [Nm, N]
    stribeck_velocity: Tensor  # where that has faded [rad/s, m/s]
    load_dependence: Tensor  # dry friction by gravity torque
    stribeck_rounding: Tensor  # by that velocity
    coulomb_smoothing_velocity: Tensor  # over which dry friction turns around [rad/s, m/s]
    least_load: Tensor  # [Nm, N]
    bristle_fractions: Tensor  # of dry friction, (n, K); a joint's add up to one, or are zero
    bristle_reach: Tensor  # (n, K) [rad, m]
    memoryless: Tensor  # 1 where dry friction follows velocity alone, 0 where bristles

    def viscosity(self, qd: Tensor) -> Tensor:
        """Torque by velocity, (..., n)."""
        return self.viscous + self.saturation * turning(qd, self.saturation_velocity)

    def dry(self, qd: Tensor, gravity: Tensor) -> Tensor:
        """The size of dry friction, (..., n) [Nm, N]."""
        speed = qd.abs() / self.stribeck_velocity
        rounding = self.stribeck_rounding
        slow = 1 / (1 + (1 + rounding) / 8 * speed.square() / (speed + rounding))
        slow = slow.square().square().square()  # a power of 8 takes twice the time
        load = (gravity.square() + self.least_load**2).sqrt()
        return self.coulomb + self.stribeck * slow + self.load_dependence * load

    def torque(
        self, qd: Tensor, gravity: Tensor, z: Tensor | None = None, direction: Tensor | None = None
    ) -> Tensor:
        """The friction torque, (..., n) [Nm, N], under this gravity torque, of bristles at z, (..., n, K).

        z: None where nothing is known of the way here; all joints are then without memory.
        direction: (..., n) of joints without memory; None: that of qd.
        """
        if direction is None:
            direction = qd * turning(qd, self.coulomb_smoothing_velocity)
        if z is not None:
            bent = (self.bristle_fractions / self.bristle_reach * z).sum(dim=-1)
            direction = bent + self.memoryless * direction
        return self.viscosity(qd) * qd + self.dry(qd, gravity) * direction

    def stored_energy(self, z: Tensor) -> Tensor:
        """What the bristles of Coulomb friction give back, (...) [J]."""
        stored = self.bristle_fractions * z.square() / self.bristle_reach
        return 0.5 * (self.coulomb * stored.sum(dim=-1)).sum(dim=-1)


class FrictionLaws(nn.Module):
    """Friction which resists whatever the weights are: they are logarithms.

    viscous qd + saturation turned(qd, saturation_velocity)
    + (coulomb + stribeck / (1 + (1 + r) v^2 / (v + r) / 8)^8 + load_dependence load) direction, with
    v = |qd| / stribeck_velocity, r the rounding, load = sqrt(gravity torque^2 + least_load^2) and
    turned(x, width) = x / sqrt(x^2 + width^2).

    The direction, from -1 to 1, is that of the bristles, sum of fraction z / reach; at joints without
    memory, or where nothing is known of the way here, turned(qd, coulomb_smoothing_velocity).
    No law has an exponential: a control loop has them in a third of the time. The Stribeck effect is
    nearly the Gaussian of Armstrong-Helouvry (Control of Machines with Friction, 1991) where r is large, and
    the exponential of Bo and Pavelescu (Wear 82:277, 1982), without its corner at rest, where it is small.

    Bristles are K elements a joint, elastic up to their reach, sliding beyond; z is (..., n, K) [rad, m]
    (Maxwell-slip elements: Lampaert, Al-Bender and Swevers, A Generalized Maxwell-Slip Friction Model, 2003).
    What turns around within the reach closes its loop, so a joint that stiction stops does not creep where
    its load oscillates.
    """

    # weight, kind, unit, and the constant that a zero stands for, by usual friction and velocity
    kinds: tuple[tuple[str, str, str, float], ...] = (
        ("raw_viscous", "sizes", "Nm s/rad, N s/m", 1.0),
        ("raw_saturation", "effects", "Nm, N", 1.0),
        ("raw_saturation_velocity", "velocities", "rad/s, m/s", 0.2),
        ("raw_coulomb", "sizes", "Nm, N", 1.0),
        ("raw_stribeck", "effects", "Nm, N", 0.3),
        ("raw_stribeck_velocity", "velocities", "rad/s, m/s", 0.03),
        ("raw_load_dependence", "load_dependence", "1", 0.03),
        ("raw_bristle_fractions", "fractions", "1", 1.0),
    )

    def __init__(self, friction: Row, speed: Row, reach: Rows) -> None:
        super().__init__()
        self.nominal, self.speed = nn.Buffer(vector(friction)), nn.Buffer(vector(speed))
        self.reach = nn.Buffer(torch.tensor(reach, dtype=torch.float64))  # (n, K), a joint's shortest first
        # no parameter: a fit to torques compares both forms
        self.memoryless = nn.Buffer(torch.zeros_like(self.speed))
        self.stribeck_rounding = nn.Buffer(torch.full_like(self.speed, 10.0))
        for name, *_ in FrictionLaws.kinds[:-1]:
            self.register_parameter(name, nn.Parameter(torch.zeros_like(self.speed)))
        self.raw_bristle_fractions = nn.Parameter(torch.zeros_like(self.reach))

    def prepare(self) -> FrictionConstants:
        """The constants, in their units."""
        size, speed, laws = self.nominal, self.speed, []
        units = {"Nm s/rad, N s/m": size / speed, "Nm, N": size, "rad/s, m/s": speed, "1": size.sign()}
        for name, _, unit, start in FrictionLaws.kinds[:-1]:
            laws.append(start * units[unit] * getattr(self, name).exp())
        load = LEAST_LOAD * torch.where(size > 0, size, 1.0)
        fractions = self.raw_bristle_fractions.softmax(dim=-1) * (1 - self.memoryless).unsqueeze(-1)
        rounding, sharp = self.stribeck_rounding, SHARP_VELOCITY * speed
        return FrictionConstants._make([*laws, rounding, sharp, load, fractions, self.reach, self.memoryless])


def turning(velocity: Tensor, width: Tensor) -> Tensor:
    """1 / sqrt(velocity^2 + width^2), (..., n): times the velocity it turns around over this width."""
    return torch.rsqrt(velocity * velocity + width**2)
