"""The drive of one joint, and motors that are coupled to several joints."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field, field_validator, model_validator

from spelgen.settings.values import Group, Inputs, NonNegative, Number, Positive


class JointSettings(Group):
    """Drive of one joint. A prismatic joint has m in place of rad, N in place of Nm and kg in place of kg m^2.

    Attributes:
        rotor_inertia: Rotor inertia of the motor, before the gear [kg m^2].
        gear: Motor revolutions per joint revolution.
        viscous: Viscous friction coefficient, after the gear [Nm s/rad].
        coulomb: Coulomb friction torque for qd > 0 and for qd < 0, after the gear, e.g. [0.395, -0.435] [Nm].
        actuated: False for a passive joint, which has no input.
        kp: Known stiffness of a position servo; without a value it is trained [Nm/rad].
        gain: "trained" if the factor from logged motor torques to joint torques is trained, with `gear` as its initial
            value.
        inputs: Torques of this joint in random-inputs simulations, in place of `simulation.inputs` [Nm].
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
        """Rotor inertia on the joint side of the gear [kg m^2]."""
        return self.rotor_inertia * self.gear**2

    @field_validator("coulomb")
    @classmethod
    def _resists(cls, value: tuple[float, float]) -> tuple[float, float]:
        if value[0] < 0 or value[1] > 0:
            raise ValueError("the torque for qd > 0 (not negative), then for qd < 0 (not positive)")
        return value


class MotorCoupling(Group):
    """Joints that are driven by the same motors: joint torques = `matrix` times motor torques.

    Attributes:
        joints: Names of the n coupled joints.
        matrix: Rows of the invertible (n, n) matrix, one row per joint and one column per motor.
    """

    joints: Annotated[tuple[str, ...], Field(min_length=2)]
    matrix: tuple[tuple[Number, ...], ...]

    @model_validator(mode="after")
    def _invertible(self) -> MotorCoupling:
        if {len(self.matrix), *map(len, self.matrix)} != {len(self.joints)}:
            raise ValueError("as many rows, and as many numbers in each, as joints")
        rows = np.array(self.matrix)
        # the rank is tested after scaling each row, as the motors of different joints may have different units
        largest = np.abs(rows).max(axis=1, keepdims=True, initial=0.0)
        if np.linalg.matrix_rank(rows / np.where(largest > 0, largest, 1.0)) < len(self.joints):
            raise ValueError("a matrix with an inverse: as many independent motors as joints")
        return self
