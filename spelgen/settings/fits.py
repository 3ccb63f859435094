"""Configurations of fits: one class per objective, with exactly the options that apply to the objective.

`OWNERS` lists the objectives to which each option applies; an option of another objective is an `OptionError`.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal, Self

from pydantic import Field, model_validator

from spelgen.errors import OptionError, SettingsError, suggestion
from spelgen.settings.yaml_document import Count, Group, NonNegative, Positive, Whole, validated

Objective = Literal["torque", "momentum", "rollout", "servo"]
Optimizer = Literal["adamw", "lbfgs"]
Adaptation = Literal["load", "friction", "unit"]
Solver = Literal["rk4", "dopri5"]
Window = Annotated[Count, Field(ge=2)]
# The number of integrator steps per sample interval is bounded, because the duration of a fit is proportional to it.
Substeps = Annotated[Count, Field(le=1000)]


@dataclass(frozen=True)
class WindowFitDefaults:
    """Default options of the optimizers of fits to windows of logs, chosen with the arms of `benchmarks/arms.py`."""

    # [1] Largest number of windows for which L-BFGS with all windows in each step is the default optimizer. For more
    # windows the default is AdamW.
    few_windows: int = 1024
    # [1] Weight decay of L-BFGS: factor of half the sum of squared weights that is added to the loss.
    lbfgs_decay: float = 2e-5
    # [1] Weight decay of AdamW (Loshchilov and Hutter, ICLR 2019).
    adamw_decay: float = 0.2
    # [1] Number of windows per step of AdamW.
    batch: int = 256
    # [1] Largest learning rate of AdamW: the default value of the authors of this optimizer.
    learning_rate: float = 1e-3


DEFAULTS = WindowFitDefaults()
# Options that apply only with a certain value of another option:
# {name: (other option, value with which the option applies, value with which it does not apply)}.
UNLESS = {
    "batch": ("optimizer", "adamw", "lbfgs"),
    "learning_rate": ("optimizer", "adamw", "lbfgs"),
    "substeps": ("solver", "rk4", "dopri5"),
}


class GaussianPrior(Group):
    """Standard deviations of the Gaussian prior of rigid-body and friction parameters about their initial values.

    The parameters are logarithms or fractions without unit. Typical friction is 2 % of a joint's effort limit, and the
    typical speed is the velocity limit, if the URDF has these limits. The fit estimates the standard deviations of
    bodies, armature and offset; the values here are their initial values.

    Attributes:
        bodies: Log-Cholesky parameters of the inertias; 0.1 is about 10 % of the mass and of the radii of gyration.
        offset: Torque offset, divided by the typical friction torque.
        gains: Logarithm of the motor gains.
        armature: Logarithm of the armature, per joint.
        sizes: Logarithm of the friction coefficients, per joint.
        velocities: Logarithm of the velocity scales of friction, per joint.
        fractions: Logits of the bristle fractions, per joint: the shares of a joint's dry friction that bristles carry.
        shared_armature: Logarithm of a factor on the armatures of all joints.
        shared_sizes: Logarithm of a factor on one friction effect, such as viscous friction, of all joints.
        shared_velocities: Logarithm of a factor on one velocity scale of friction of all joints.
        shared_fractions: Part of the logit of one bristle fraction that is equal for all joints.
        shared_friction: Logarithm of a factor on all friction of all joints.
        friction_compensation: Torque per velocity with which a drive compensates friction, divided by typical friction
            per typical speed. It is fitted only if the logs, or implausible masses, indicate such a torque.
        degrees_of_freedom: Not a standard deviation but the weight c of the initial values: a standard deviation s is
            estimated by s^2 = (sum of squares + c s0^2) / (k + c), with its initial value s0 and the effective number k
            of its fitted parameters. The standard deviation of each single body is estimated with the same c, so that
            the prior of its parameters is a Student-t distribution with c degrees of freedom.
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
    friction_compensation: Positive = 100.0
    degrees_of_freedom: Positive = 4.0


class FitConfig(Group):
    """Base class of the options of a fit; each objective (torque, momentum, rollout, servo) has a class of its own.

    of_rigid_bodies: names of the options that apply only to models of rigid bodies. of_networks: names of the options
    that apply only to models of networks.
    """

    objective: ClassVar[Objective]
    of_rigid_bodies: ClassVar[tuple[str, ...]] = ()
    of_networks: ClassVar[tuple[str, ...]] = ()

    @model_validator(mode="before")
    @classmethod
    def _refuse_foreign(cls, options: object) -> object:
        for name in options if isinstance(options, Mapping) else ():
            # The option may exist for other objectives only. The message then states these objectives.
            if name not in cls.model_fields:
                owners = OWNERS.get(name)
                if owners is None:
                    raise SettingsError(f"unknown option {name!r}", do=suggestion(name, cls.model_fields))
                objectives = f"objective{'s' * (len(owners) > 1)} {' and '.join(owners)}"
                raise OptionError(name, f"belongs to the {objectives}, this fits {cls.objective}")
        return options

    @model_validator(mode="after")
    def _agree(self) -> Self:
        options = dict(self)
        for name, (condition, required, excluded) in UNLESS.items():
            if options.get(name) is not None and options.get(condition) == excluded:
                raise OptionError(name, f"belongs to the {condition} {required}, this is {excluded}")
        return self

    def require(self, *, rigid_bodies: bool) -> None:
        """Raise OptionError if the objective, or an option that the caller has set, does not apply to a type of model.

        rigid_bodies: True for a model of rigid bodies, False for a model of networks.
        """
        # The momentum objective does not apply to models of rigid bodies, which are fitted to torques directly.
        if rigid_bodies and self.objective == "momentum":
            raise OptionError(
                "objective", "momentum is for models that consist of networks; this model has rigid bodies"
            )
        models = "models that consist of networks" if rigid_bodies else "models of rigid bodies"
        for name in self.unused(rigid_bodies=rigid_bodies):
            if name in self.model_fields_set:
                raise OptionError(name, f"with the objective {self.objective} belongs to {models}")

    def record(self, *, rigid_bodies: bool) -> dict[str, object]:
        """Return {name: value} of the options that apply to a type of model and are not None, for config.json.

        rigid_bodies: True for a model of rigid bodies, False for a model of networks.
        """
        return self.model_dump(
            mode="json", exclude_none=True, exclude=set(self.unused(rigid_bodies=rigid_bodies))
        )

    @classmethod
    def unused(cls, *, rigid_bodies: bool) -> tuple[str, ...]:
        """Return the names of the options that do not apply to a type of model.

        rigid_bodies: True for a model of rigid bodies, False for a model of networks.
        """
        return cls.of_networks if rigid_bodies else cls.of_rigid_bodies


class TorqueFit(FitConfig):
    """Fit of inverse dynamics to measured torques, on samples at 100 Hz with motion.

    Rigid-body models: MAP estimate by Levenberg-Marquardt. Network models: L-BFGS on the squared torque residual, with
    weight decay and a regularization towards the URDF (see `UrdfRegularizer`).

    Attributes:
        prior: Prior of the parameters of rigid-body models.
        adapt: Parameters of a fitted model to update. `load`: the last body, with a load at the tip (in models of
            networks: M and V); `friction`: friction and torque offsets; `unit`: all, for another arm of the same model.
        evaluations: Largest number of evaluations of the loss.
        weight_decay: Factor of half the sum of squared weights.
        urdf_weight: Factor of the squared difference from the URDF's M and gravity; 0: no regularization.
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
    """Options of fits that minimize a loss over windows of logs.

    Attributes:
        window: Samples per window.
        stride: Samples from the start of one window to the start of the next.
        momentum_steps: Training steps of the momentum fit, on the weak form of the equations of motion.
        optimizer: AdamW on batches, or L-BFGS on all windows; default: lbfgs for at most 1,024 windows, else adamw.
        batch: Windows per step of AdamW; default: 256.
        learning_rate: Largest learning rate of AdamW; default: 0.001.
        weight_decay: With AdamW: its weight decay, default: 0.2. With L-BFGS: factor of half the sum of squared weights
            in the loss, default: 2e-05.
        urdf_weight: Factor of the squared difference from the URDF's M and gravity; 0: no regularization.
        max_minutes: Time limit, within which the learning rate is annealed [min].
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
        """Return the configuration with an optimizer, and with the batch, learning rate and weight decay for it.

        windows: number of training windows, on which the default optimizer depends.
        """
        # L-BFGS converges in few steps, but each step needs all windows: it is the default for few windows only.
        optimizer = self.optimizer or ("lbfgs" if windows <= DEFAULTS.few_windows else "adamw")
        update: dict[str, object] = {"optimizer": optimizer, "batch": None, "learning_rate": None}
        decay = DEFAULTS.lbfgs_decay
        if optimizer == "adamw":
            decay, update["batch"] = DEFAULTS.adamw_decay, self.batch or DEFAULTS.batch
            update["learning_rate"] = self.learning_rate or DEFAULTS.learning_rate
        if self.weight_decay is None:
            update["weight_decay"] = decay
        return self.model_copy(update=update)


class MomentumFit(OnWindows):
    """Fit of the weak form of the equations of motion to measured windows.

    The loss compares the change of momentum between samples with the impulse of the torques. It needs neither
    accelerations nor an ODE solver. The result is used only if it predicts the validation windows better than the
    initial model.
    """

    objective: ClassVar[Objective] = "momentum"


class Rollout(OnWindows):
    """Fit that minimizes the difference between simulated and measured states in windows of logs.

    The method is Algorithm 1 of SPEL (Wang, Chen and Ding, Sci. Rep. 15:33179, 2025), without its penalty for mass
    matrices that are not positive definite. There are up to three stages: a torque fit of rigid bodies (see
    `TorqueFit`), a momentum fit (see `MomentumFit`), and the fit of rollouts, which are simulated windows.

    Attributes:
        torque_first: Whether the torque fit is made.
        epochs: Largest number of passes over all windows.
        patience: Number of epochs without a better validation loss after which the fit ends.
        solver: Integrator of the predictions: rk4 with fixed steps, or dopri5 of torchdiffeq.
        substeps: Steps of rk4 per sample interval; default: determined from the robot.
    """

    objective: ClassVar[Objective] = "rollout"
    of_rigid_bodies: ClassVar[tuple[str, ...]] = ("torque_first",)

    torque_first: bool = True
    epochs: Count = 400
    patience: Count = 60
    solver: Solver = "rk4"
    substeps: Substeps | None = None


class ServoFit(FitConfig):
    """Fit of servo, friction and gravity parameters to logged positions under commands (see `fitting.servo`)."""

    objective: ClassVar[Objective] = "servo"


WindowConfig = MomentumFit | Rollout
CONFIGS: dict[str, type[FitConfig]] = {x.objective: x for x in (TorqueFit, MomentumFit, Rollout, ServoFit)}
OWNERS: dict[str, list[str]] = {}
for _config in CONFIGS.values():
    for _name in _config.model_fields:
        OWNERS.setdefault(_name, []).append(_config.objective)


def fit_config(
    objective: str,
    *,
    rigid_bodies: bool,
    options: Mapping[str, object] | None = None,
    defaults: Mapping[str, object] | None = None,
) -> FitConfig:
    """Return the configuration of a fit, from options of the caller and settings of the robot.

    Args:
        objective: Name of the objective, a key of ``CONFIGS``.
        rigid_bodies: Whether the model consists of rigid bodies, not of networks.
        options: Options of the caller. An option that does not apply raises OptionError.
        defaults: Options in the settings of the robot. Options that do not apply are ignored.
    """
    config_type, options = CONFIGS[objective], dict(options or {})
    applicable = config_type.model_fields.keys() - config_type.unused(rigid_bodies=rigid_bodies)
    settings = {name: value for name, value in (defaults or {}).items() if name in applicable}
    for name, (condition, _, excluded) in UNLESS.items():
        if options.get(condition, settings.get(condition)) == excluded:
            settings.pop(name, None)
        # Options of the caller override settings of the robot. For example, the option `batch` has no effect with the
        # setting `optimizer: lbfgs`, so this setting is ignored if the caller specifies `batch`.
        elif name in options and condition not in options and settings.get(condition) == excluded:
            settings.pop(condition)
    config = validated(config_type, settings | options)
    config.require(rigid_bodies=rigid_bodies)
    return config
