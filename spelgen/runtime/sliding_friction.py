"""The same friction without bristles: dry friction depends on velocity only."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import nn

from spelgen.runtime.friction_laws import FrictionConstants, FrictionLaws
from spelgen.runtime.rows import Joint

# Initial velocity over which dry friction changes its direction, relative to the typical speed.
SMOOTHING_VELOCITY = 0.006


class SlidingFriction(FrictionLaws):
    """Friction without a state, with a trained smoothing velocity of dry friction."""

    parameter_groups = (("raw_coulomb_smoothing_velocity", "velocities", "rad/s, m/s", SMOOTHING_VELOCITY),)

    def __init__(self, joints: Sequence[Joint]) -> None:
        super().__init__(joints, breakaway={"revolute": (), "prismatic": ()})
        self.memoryless.fill_(1.0)
        self.raw_coulomb_smoothing_velocity = nn.Parameter(torch.zeros_like(self.speed))
        del self.raw_bristle_fractions
        self.register_buffer("raw_bristle_fractions", self.reach)  # (n, 0)

    def prepare(self) -> FrictionConstants:
        """Return the constants in SI units."""
        velocity = SMOOTHING_VELOCITY * self.speed * self.raw_coulomb_smoothing_velocity.exp()
        return super().prepare()._replace(coulomb_smoothing_velocity=velocity)
