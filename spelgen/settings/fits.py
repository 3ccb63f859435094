"""What a model is fitted to, and how: one class for each objective, with the options that apply to it and no others.

`OWNERS` says of every option which objectives it belongs to; an option of another one is an `OptionError`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal, Self

from pydantic import Field, model_validator

from spelgen.errors import OptionError, SettingsError, suggestion
from spelgen.settings.messages import validated
from spelgen.settings.values import Count, Group, NonNegative, Positive, Whole

Objective = Literal["torque", "momentum", "rollout", "servo"]
Optimizer = Literal["adamw", "lbfgs"]
Adaptation = Literal["load", "friction", "unit"]
Solver = Literal["rk4", "dopri5"]
Window = Annotated[Count, Field(ge=2)]
Substeps = Annotated[Count, Field(le=1000)]  # more never end


@dataclass(frozen=True)
class WindowFitDefaults:
    """Defaults of the optimizers of fits to windows; chosen on the arms of `benchmarks/arms.py`."""

    # [1] Up to this number of windows L-BFGS takes all of them in every step; AdamW is the default for more.
    few_windows: int = 1024
    # [1] Weight decay of L-BFGS: factor of half the sum of squared weights, in units of the loss.
    lbfgs_decay: float = 2e-5
    # [1] Weight decay of AdamW (Loshchilov and Hutter, ICLR 2019).
    adamw_decay: float = 0.2
    # [1] Windows per step of AdamW.
    batch: int = 256
    # [1] Largest learning rate of AdamW: the default of its authors.
    learning_rate: float = 1e-3


DEFAULTS = WindowFitDefaults()
UNLESS = {  # options that belong to one value of another option
    "batch": ("optimizer", "adamw", "lbfgs"),
    "learning_rate": ("optimizer", "adamw", "lbfgs"),
    "substeps": ("solver", "rk4", "dopri5"),
}


class GaussianPrior(Group):
    """How far the weights of a model of rigid bodies may be from where they start: standard deviations.

    The weights are logarithms or fractions and so have no unit. bodies: of log-Cholesky parameters, 0.1 is 10 % in
    mass and in the size along each axis. offset: in usual sizes of friction. armature, sizes and velocities of
    friction, fractions of its bristles: of each joint by itself; shared_*: of all joints together, of one effect
    (`shared_sizes`), of one element of bristles (`shared_fractions`) or of all friction (`shared_friction`).
    friction_compensation: of a drive, in usual sizes of friction at usual speed, where logs show one.
    bodies, armature and offset are first guesses, which count as `degrees_of_freedom` weights: how far those turn out
    to be from where they start is found by the fit (see `update_widths`).
    """

    bodies: Positive = 0.75
    offset: Positive = 0.1
    gains: Positive = 0.3
    armature: Positive = 1.0
    sizes: Positive = 1.0
    velocities: Positive = 0.7
    fractions: Positive = 1.0
    shared_armature: NonNegative = 3.0
    shared_sizes: NonNegative = 1.0
    shared_velocities: NonNegative = 1.0
    shared_fractions: NonNegative = 3.0
    shared_friction: NonNegative = 3.0
    friction_compensation: Positive = 1000.0
    degrees_of_freedom: Positive = 4.0


class FitConfig(Group):
    """What the objectives have in common: to know which options are theirs."""

    objective: ClassVar[Objective]
    of_rigid_bodies: ClassVar[tuple[str, ...]] = ()
    of_networks: ClassVar[tuple[str, ...]] = ()

    @model_validator(mode="before")
    @classmethod
    def _refuse_foreign(cls, options: object) -> object:
        for name in options if isinstance(options, Mapping) else ():
            if name not in cls.model_fields:
                owners = OWNERS.get(name)
                if owners is None:
                    raise SettingsError(f"unknown option {name!r}", do=suggestion(name, cls.model_fields))
                objectives = f"objective{'s' * (len(owners) > 1)} {' and '.join(owners)}"
                raise OptionError(name, f"belongs to the {objectives}, this fits {cls.objective}")
        return options

    @model_validator(mode="after")
    def _agree(self) -> Self:
        for name, (other, needed, against) in UNLESS.items():
            if getattr(self, name, None) is not None and getattr(self, other, None) == against:
                raise OptionError(name, f"belongs to the {other} {needed}, this is {against}")
        return self

    def require(self, *, rigid_bodies: bool) -> None:
        """Raise OptionError for an option that was given and does not apply to this kind of model."""
        if rigid_bodies and self.objective == "momentum":
            raise OptionError(
                "objective", "momentum belongs to models of networks alone, this is one of rigid bodies"
            )
        kind = "models of networks alone" if rigid_bodies else "models of rigid bodies"
        for name in self.unused(rigid_bodies=rigid_bodies):
            if name in self.model_fields_set:
                raise OptionError(name, f"with the objective {self.objective} belongs to {kind}")

    def record(self, *, rigid_bodies: bool) -> dict[str, object]:
        """Return the options that apply, for config.json."""
        unused = self.unused(rigid_bodies=rigid_bodies)
        return self.model_dump(mode="json", exclude_none=True, exclude=set(unused))

    @classmethod
    def unused(cls, *, rigid_bodies: bool) -> tuple[str, ...]:
        """Return the options that do not apply to this kind of model."""
        return cls.of_networks if rigid_bodies else cls.of_rigid_bodies


class TorqueFit(FitConfig):
    """Fit the torque of the model's inverse dynamics to the measured one, on samples at 100 Hz that move.

    Rigid bodies by Gauss-Newton steps to their most probable weights after `prior`. A model of networks by L-BFGS, with
    at most `evaluations` of the loss, to which are added `weight_decay` times half the sum of squares of all
    weights, and `urdf_weight` times the distance from the URDF (see `UrdfRegularizer`).
    adapt: what of a fitted model moves, from where it is: a `load` at the tip (the last body; of networks M and V), the
    `friction` of another day with the torque offsets, or all that differs in another `unit` of the same arm.
    """

    objective: ClassVar[Objective] = "torque"
    of_rigid_bodies: ClassVar[tuple[str, ...]] = ("prior",)
    of_networks: ClassVar[tuple[str, ...]] = ("evaluations", "weight_decay", "urdf_weight")

    prior: GaussianPrior | None = None
    adapt: Adaptation | None = None
    evaluations: Count = 2000
    weight_decay: NonNegative = DEFAULTS.lbfgs_decay
    urdf_weight: NonNegative = 1.0


class OnWindows(FitConfig):
    """Options of the objectives that step down a loss of windows.

    window: samples predicted together. stride: samples from the start of one window to the next.
    optimizer: AdamW on batches or L-BFGS on all windows at once; None: L-BFGS where these are few.
    batch: windows in a step of AdamW. learning_rate: of AdamW, at its largest. weight_decay: of AdamW, or the weight
    of L-BFGS's penalty; None: what suits the optimizer.
    momentum_steps: on the weak form of the equations (see `momentum_loss`).
    urdf_weight: of staying near the URDF's own M and gravity (see `UrdfRegularizer`); 0: none.
    max_minutes: the learning rate is annealed within this time too.
    """

    window: Window = 5
    stride: Count = 1
    momentum_steps: Whole = 2000
    optimizer: Optimizer | None = None
    batch: Count | None = None
    learning_rate: Positive | None = None
    weight_decay: NonNegative | None = None
    urdf_weight: NonNegative = 1.0
    max_minutes: NonNegative | None = None

    def resolved(self, windows: int) -> Self:
        """Return the same with optimizer, batch, learning rate and weight decay decided for so many windows."""
        optimizer = self.optimizer or ("lbfgs" if windows <= DEFAULTS.few_windows else "adamw")
        update: dict[str, object] = {"optimizer": optimizer, "batch": None, "learning_rate": None}
        decay = DEFAULTS.lbfgs_decay
        if optimizer == "adamw":
            update["batch"] = self.batch or DEFAULTS.batch
            update["learning_rate"] = self.learning_rate or DEFAULTS.learning_rate
            decay = DEFAULTS.adamw_decay
        if self.weight_decay is None:
            update["weight_decay"] = decay
        return self.model_copy(update=update)


class MomentumFit(OnWindows):
    """Fit the weak form of the equations alone: change of momentum against impulse along measured windows.

    Neither accelerations nor an ODE solver are needed. Kept only if it predicts the validation windows better than
    the model did before.
    """

    objective: ClassVar[Objective] = "momentum"


class Rollout(OnWindows):
    """Fit predicted windows, in up to three stages: torque, momentum, windows (SPEL, Algorithm 1, no PD penalty).

    First, with `torque_first`, rigid bodies are fitted to torques as `TorqueFit` does. Then come
    `momentum_steps` as of `MomentumFit`, kept where they help. Then windows are predicted by `solver`: rk4 with
    `substeps` per sample interval (None: as many as the robot needs) or dopri5 of torchdiffeq.
    epochs: passes over all windows, at most. patience: epochs without a better validation loss before the end.
    """

    objective: ClassVar[Objective] = "rollout"
    of_rigid_bodies: ClassVar[tuple[str, ...]] = ("torque_first",)

    torque_first: bool = True
    epochs: Count = 400
    patience: Count = 60
    solver: Solver = "rk4"
    substeps: Substeps | None = None


class ServoFit(FitConfig):
    """Fit position servos, friction and weight of an arm to what follows its commands (see `fitting.servo`)."""

    objective: ClassVar[Objective] = "servo"


WindowConfig = MomentumFit | Rollout
CONFIGS: dict[str, type[FitConfig]] = {
    "torque": TorqueFit,
    "momentum": MomentumFit,
    "rollout": Rollout,
    "servo": ServoFit,
}


OWNERS: dict[str, list[str]] = {}
for _objective, _config in CONFIGS.items():
    for _name in _config.model_fields:
        OWNERS.setdefault(_name, []).append(_objective)


def fit_config(
    objective: str,
    *,
    rigid_bodies: bool,
    options: Mapping[str, object] | None = None,
    defaults: Mapping[str, object] | None = None,
) -> FitConfig:
    """Return the configuration of an objective. Raises OptionError for an option that does not apply to what is fitted.

    Of ``defaults``, a robot's settings for whatever is fitted, those that do not apply are left out.
    """
    kind, options, settings = CONFIGS[objective], dict(options or {}), dict(defaults or {})
    for name in settings.keys() - (kind.model_fields.keys() - kind.unused(rigid_bodies=rigid_bodies)):
        del settings[name]
    for name, (other, _, against) in UNLESS.items():
        if options.get(other, settings.get(other)) == against:
            settings.pop(name, None)
        elif name in options and other not in options and settings.get(other) == against:
            settings.pop(other)
    config = validated(kind, settings | options)
    config.require(rigid_bodies=rigid_bodies)
    return config
