"""Defaults of `spelgen train` for one robot."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import Field, ValidationInfo, field_validator

from spelgen.settings.fits import OWNERS, GaussianPrior, Objective, Optimizer, Solver, Substeps, Window
from spelgen.settings.log_mapping import LONGEST_DELAY
from spelgen.settings.values import Count, Group, NonNegative, Number, Positive, Whole


class TrainingSettings(Group):
    """Hold the defaults of `spelgen train` for a robot; command-line flags override them. None: not set here.

    objective: what is fitted; an option that belongs to others only is an error beside it. The options are those of
    `TorqueFit`, `MomentumFit` and `Rollout`; those of `Preprocessing` stand beside them.
    validation_fraction: part of the training trajectories held out to watch the validation loss.
    """

    objective: Objective | None = None
    prior: GaussianPrior | None = None
    evaluations: Count | None = None
    torque_first: bool | None = None
    momentum_steps: Whole | None = None
    urdf_weight: NonNegative | None = None
    window: Window | None = None
    stride: Count | None = None
    epochs: Count | None = None
    patience: Count | None = None
    optimizer: Optimizer | None = None
    batch: Count | None = None
    learning_rate: Positive | None = None
    weight_decay: NonNegative | None = None
    solver: Solver | None = None
    substeps: Substeps | None = None
    max_minutes: NonNegative | None = None
    cutoff: NonNegative | None = None
    decimation: Count | None = None
    gap: Annotated[Number, Field(gt=1)] | None = None
    torque_delay: Annotated[Number, Field(ge=-LONGEST_DELAY, le=LONGEST_DELAY)] | None = None
    validation_fraction: Annotated[Number, Field(gt=0, lt=1)] = 0.25
    seed: Whole = 0

    @field_validator("*")
    @classmethod
    def _belongs(cls, value: object, info: ValidationInfo) -> object:
        objective, owners = info.data.get("objective"), OWNERS.get(str(info.field_name))
        if objective and owners and objective not in owners:
            raise ValueError(
                f"nothing beside 'objective: {objective}': this belongs to {' and '.join(owners)}"
            )
        return value

    @property
    def options(self) -> dict[str, Any]:
        """Options of any objective that are set."""
        return self.model_dump(include=set(OWNERS), exclude_none=True)

    @property
    def preprocessing(self) -> dict[str, Any]:
        """Options of `Preprocessing` that are set."""
        return self.model_dump(include={"cutoff", "decimation", "gap", "torque_delay"}, exclude_none=True)
