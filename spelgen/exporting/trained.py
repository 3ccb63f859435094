"""A trained model and its arm: the input of every exporter."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

from spelgen.exporting.describe import describe
from spelgen.exporting.description import TrainedModel
from spelgen.exporting.entry_points import EntryPoint, entry_points
from spelgen.pipeline.loaded_arm import LoadedArm

if TYPE_CHECKING:
    from spelgen.emission.loading import EmittedModel


@dataclass(frozen=True, eq=False)
class Trained:
    """A trained model of an arm.

    entries: names of the functions to export, for formats of functions; by default all but derivatives.
    """

    model: EmittedModel
    arm: LoadedArm
    entries: tuple[str, ...] = ()

    @cached_property
    def described(self) -> TrainedModel:
        """The model as plain numbers. Raises RunError for a preset that has no such description."""
        return describe(self.model, self.arm)

    @cached_property
    def entry_points(self) -> dict[str, EntryPoint]:
        """The functions to export from the description, by name. Raises RunError for names of others."""
        return entry_points(self.described, self.entries)

    @property
    def robot(self) -> str:
        """The name of the robot in the URDF."""
        return self.arm.arm.name

    @property
    def joint_names(self) -> tuple[str, ...]:
        """The names of the joints in the URDF."""
        return self.arm.arm.joint_names

    @property
    def memory(self) -> int:
        """How many numbers the memory of friction has."""
        return self.model.n * int(getattr(self.model, "elements", 0))
