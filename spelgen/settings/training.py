"""Settings of `spelgen train` and `spelgen compare` for one robot."""

from typing import Annotated, Any

from pydantic import Field, ValidationInfo, field_validator

from spelgen.settings.fits import OWNERS, GaussianPrior, Objective, Optimizer, Solver, Substeps, Window
from spelgen.settings.log_mapping import LONGEST_DELAY
from spelgen.settings.yaml_document import Count, Group, NonNegative, Number, Positive, Whole

PREPROCESSING = {"cutoff", "decimation", "gap", "torque_delay"}
OF_LOGS = PREPROCESSING | {"validation_fraction", "seed"}
"""Keys about the logs; the other keys are options of fits."""


class TrainingSettings(Group):
    """Defaults of `spelgen train` for one robot; options of the command line take precedence.

    Attributes:
        objective: Objective of the fit; default: torque for models with rigid bodies, rollout for models of networks
            only, servo for arms with position servos. If it is set, options of other objectives are errors.
        cutoff: Cutoff frequency of the zero-phase low-pass filter on q, qd and tau; 0: no filter; default: 8 Hz, but
            no filter in fits to windows (short segments of logs) if a log has a sample rate of 50 Hz or less [Hz].
        decimation: A window contains every n-th sample of a log; default: the largest n that the filter allows.
        gap: A recording is split at time steps longer than this number of median steps.
        torque_delay: Delay of the logged torques relative to the positions; default: estimated in a torque fit [s].
        validation_fraction: Fraction of the training trajectories for the validation loss.
        seed: Seed of all random numbers.
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
        # pydantic validates the fields in their order, and `info.data` contains the validated ones. `objective` is the
        # first field, so its value is known.
        objective, owners = info.data.get("objective"), OWNERS.get(str(info.field_name))
        if objective and owners and objective not in owners:
            raise ValueError(
                f"no value with 'objective: {objective}': this belongs to {' and '.join(owners)}"
            )
        return value

    @property
    def options(self) -> dict[str, object]:
        """{name: value} of all settings that are options of a fit (of any objective) and are not None."""
        return self.model_dump(include=set(OWNERS), exclude_none=True)

    @property
    def preprocessing(self) -> dict[str, Any]:
        """{name: value} of all settings that are options of `Preprocessing` and are not None."""
        return self.model_dump(include=PREPROCESSING, exclude_none=True)


class PublishedFigures(Group):
    """Published figures of one preset on this robot; a figure without a value was not published.

    Attributes:
        parameters: Number of trained parameters.
        step_seconds: Duration of a training step on the authors' machine [s].
        train_loss: Mean squared errors of q and of qd in predicted training windows, summed over the joints, in rad, m
            and s.
        test_loss: Error as in `train_loss`, for predicted test windows.
        prediction_loss: Error as in `train_loss`, for predictions over 1 s.
        velocity: Mean squared error of the velocity over 1 s, summed over the joints.
        position: Mean squared error of the position over 1 s, summed over the joints.
    """

    parameters: Count | None = None
    step_seconds: Positive | None = None
    train_loss: Positive | None = None
    test_loss: Positive | None = None
    prediction_loss: Positive | None = None
    velocity: Positive | None = None
    position: Positive | None = None


class ComparisonSettings(Group):
    """Training of all presets on simulated logs of this robot by `spelgen compare`.

    Attributes:
        first: Duration of the initial part of each training motion that is used; default: the whole motion [s].
        steps: Minimum number of training steps of the rollout fit.
        momentum_steps: Number of training steps on the weak form of the equations, before the steps on predicted
            windows.
        weight_decay: Weight decay of all presets; default: as in `training`.
        seeds: Number of runs of each preset.
        width: Units per hidden layer.
        depth: Number of hidden layers.
        published: Errors and sizes of the presets in a publication about this robot, by name of the preset.
    """

    first: Positive | None = None
    steps: Count = 1500
    momentum_steps: Whole = 1000
    weight_decay: NonNegative | None = None
    seeds: Count = 5
    width: Count = 64
    depth: Count = 2
    published: dict[str, PublishedFigures] = Field(default_factory=dict)
