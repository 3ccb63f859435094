"""Friction by the same laws, without memory."""

from __future__ import annotations

import torch
from torch import nn

from spelgen.runtime.friction_laws import FrictionConstants, FrictionLaws
from spelgen.runtime.parts import Row

SMOOTHING_VELOCITY = 0.006  # over which dry friction turns around to start from, by usual velocity


class SlidingFriction(FrictionLaws):
    """Friction that has no bristles: what is dry turns around over a velocity that is trained."""

    kinds = (("raw_coulomb_smoothing_velocity", "velocities", "rad/s, m/s", SMOOTHING_VELOCITY),)

    def __init__(self, friction: Row, speed: Row) -> None:
        super().__init__(friction, speed, [[]] * len(speed))
        self.memoryless.fill_(1.0)
        self.raw_coulomb_smoothing_velocity = nn.Parameter(torch.zeros_like(self.speed))
        del self.raw_bristle_fractions
        self.register_buffer("raw_bristle_fractions", self.reach)  # none

    def prepare(self) -> FrictionConstants:
        """The constants, in their units."""
        velocity = SMOOTHING_VELOCITY * self.speed * self.raw_coulomb_smoothing_velocity.exp()
        return super().prepare()._replace(coulomb_smoothing_velocity=velocity)
