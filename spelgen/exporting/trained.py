"""What is exported: a trained model, the arm it is of, and both as plain numbers."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from spelgen.exporting.describe import describe
from spelgen.exporting.description import TrainedModel
from spelgen.exporting.tip_chain import tip_in_body
from spelgen.loaded_arm import LoadedArm

if TYPE_CHECKING:
    from spelgen.emission.loading import EmittedModel


@dataclass(frozen=True, eq=False)
class Trained:
    """A trained model of an arm."""

    model: EmittedModel
    arm: LoadedArm

    @cached_property
    def described(self) -> TrainedModel:
        """The model as plain numbers. Raises RunError for a preset that has no such description."""
        return describe(self.model, self.arm)

    @property
    def tip_in_body(self) -> tuple[str, int, np.ndarray]:
        """The tip's link, the body that it moves with, and its pose in that body's frame, (4, 4)."""
        return tip_in_body(self.arm)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """By the URDF's names."""
        return tuple(coordinate.name for coordinate in self.arm.arm.coordinates)
