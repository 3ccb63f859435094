"""The drive of one joint, and motors that move several joints together."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field, field_validator, model_validator

from spelgen.settings.values import Group, Inputs, NonNegative, Number, Positive


class JointSettings(Group):
    """Drive of one joint; N and m in place of Nm and rad when it is prismatic.

    rotor_inertia: of the motor, before the gear [kg m^2].
    gear: motor turns per joint turn.
    viscous: friction torque per joint velocity, after the gear [Nm s/rad].
    coulomb: friction torque for qd > 0 and for qd < 0, after the gear [Nm], e.g. (0.395, -0.435).
    actuated: False for a passive joint, which never gets an input.
    kp: of a position servo whose gain is known [Nm/rad]; None: it is trained.
    gain: "trained" where the gear between logged motor torques and the joint is to be learned; it starts at `gear`.
    inputs: the torques it draws from in a simulation, in place of `simulation.inputs` [Nm].
    """

    rotor_inertia: NonNegative = 0.0
    gear: Positive = 1.0
    viscous: NonNegative = 0.0
    coulomb: tuple[Number, Number] = (0.0, 0.0)
    actuated: bool = True
    kp: Positive | None = None
    gain: Literal["known", "trained"] = "known"
    inputs: Inputs | None = None

    @property
    def armature(self) -> float:
        """Rotor inertia as the joint feels it [kg m^2]."""
        return self.rotor_inertia * self.gear**2

    @field_validator("coulomb")
    @classmethod
    def _resists(cls, value: tuple[float, float]) -> tuple[float, float]:
        if value[0] < 0 or value[1] > 0:
            raise ValueError("the torque for qd > 0 (not negative), then for qd < 0 (not positive)")
        return value


class Coupling(Group):
    """Joints that the same motors move: their torques are ``matrix`` times the torques of as many motors."""

    joints: Annotated[tuple[str, ...], Field(min_length=2)]
    matrix: tuple[tuple[Number, ...], ...]

    @model_validator(mode="after")
    def _invertible(self) -> Coupling:
        if {len(self.matrix), *map(len, self.matrix)} != {len(self.joints)}:
            raise ValueError("as many rows, and as many numbers in each, as joints")
        rows = np.array(self.matrix)
        # motors in other units than their neighbours' are not dependent
        largest = np.abs(rows).max(axis=1, keepdims=True, initial=0.0)
        if np.linalg.matrix_rank(rows / np.where(largest > 0, largest, 1.0)) < len(self.joints):
            raise ValueError("a matrix with an inverse: as many independent motors as joints")
        return self
