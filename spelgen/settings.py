"""What a URDF does not say about a robot: the sidecar `rpr.yaml` beside `rpr.urdf`, checked key by key."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, field_validator

from spelgen.errors import SettingsError, collect, suggestion
from spelgen.yaml_document import Document, read_document


def _no_bool(value: object) -> object:
    if isinstance(value, bool):  # float(True) is 1.0: a misplaced `yes` would pass for a number
        raise ValueError("a number")
    return value


Number = Annotated[float, BeforeValidator(_no_bool), Field(allow_inf_nan=False)]
Positive = Annotated[Number, Field(gt=0)]
NonNegative = Annotated[Number, Field(ge=0)]
Fraction = Annotated[Number, Field(ge=0, lt=1)]
Count = Annotated[int, BeforeValidator(_no_bool), Field(ge=1)]
Inputs = Annotated[tuple[Number, ...], Field(min_length=1)]
Seed = Annotated[int, BeforeValidator(_no_bool), Field(ge=0)]


class _Group(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class JointSettings(_Group):
    """Drive of one joint; N and m in place of Nm and rad when it is prismatic.

    rotor_inertia: of the motor, before the gear [kg m^2]; the joint feels rotor_inertia * gear^2.
    gear: motor turns per joint turn.
    viscous: friction torque per joint velocity, after the gear [Nm s/rad].
    coulomb: friction torque for qd > 0 and for qd < 0, after the gear [Nm], e.g. (0.395, -0.435).
    actuated: False for a passive joint, which never gets an input.
    inputs: the torques it draws from in a simulation, in place of `simulation.inputs` [Nm].
    """

    rotor_inertia: NonNegative = 0.0
    gear: Positive = 1.0
    viscous: NonNegative = 0.0
    coulomb: tuple[Number, Number] = (0.0, 0.0)
    actuated: bool = True
    inputs: Inputs | None = None

    @field_validator("coulomb")
    @classmethod
    def _resists(cls, value: tuple[float, float]) -> tuple[float, float]:
        if value[0] < 0 or value[1] > 0:
            raise ValueError("the torque for qd > 0 (not negative), then for qd < 0 (not positive)")
        return value


class SimulationSettings(_Group):
    """How `spelgen simulate` makes logs.

    trajectories: number, each from its own initial position, at rest.
    duration: of each [s]. rate: of samples and of the inputs, which are held in between [Hz].
    inputs: the torques each actuated joint draws from, every sample anew [Nm].
    test_fraction: part of the trajectories kept for testing.
    positions: joint -> (lowest, highest) initial position [rad]; not given: its limits, +-pi if continuous.
    friction_velocity: width of the tanh in place of Coulomb friction's jump [rad/s].
    """

    protocol: Literal["random-inputs"] = "random-inputs"
    trajectories: Count = 64
    duration: Positive = 1.0
    rate: Positive = 20.0
    inputs: Inputs = (-2.0, -1.0, 0.0, 1.0, 2.0)
    test_fraction: Fraction = 0.5
    positions: dict[str, tuple[Number, Number]] | None = None
    friction_velocity: Positive = 0.05
    seed: Seed = 0

    @field_validator("positions")
    @classmethod
    def _ordered(cls, value: dict[str, tuple[float, float]] | None) -> dict[str, tuple[float, float]] | None:
        for name, (lowest, highest) in (value or {}).items():
            if lowest > highest:
                raise ValueError(f"the lowest position of {name!r} first, then the highest")
        return value


class TrainingSettings(_Group):
    """Defaults of `spelgen train`; command-line flags override them.

    window: samples predicted together. stride: samples from the start of one window to the next.
    batch: windows per step. epochs: passes over all windows, at most.
    patience: epochs without a better validation loss before stopping.
    momentum_steps: steps on the weak form (see `momentum_loss`) before windows are predicted.
    prior: weight of staying near the URDF's own M and gravity (see `Prior`); 0: none.
    substeps: integrator steps per sample interval; None: as many as the robot needs.
    validation_fraction: part of the training trajectories held out to watch the validation loss.
    """

    objective: Literal["rollout"] = "rollout"
    momentum_steps: Annotated[int, BeforeValidator(_no_bool), Field(ge=0)] = 2000
    prior: NonNegative = 1.0
    window: Annotated[Count, Field(ge=2)] = 5
    stride: Count = 1
    epochs: Count = 400
    batch: Count = 256
    learning_rate: Positive = 1e-3
    weight_decay: NonNegative = 0.2
    substeps: Count | None = None
    validation_fraction: Annotated[Number, Field(gt=0, lt=1)] = 0.25
    patience: Count = 60
    seed: Seed = 0


class ComparisonSettings(_Group):
    """How `spelgen compare` trains every preset on this robot's simulated logs.

    first: only so much of each training trajectory is trained on [s]; None: all. steps: of training, at least.
    momentum_steps: before these. seeds: runs of each preset. width, depth: of the hidden layers.
    """

    first: Positive | None = None
    steps: Count = 1500
    momentum_steps: Annotated[int, BeforeValidator(_no_bool), Field(ge=0)] = 1000
    seeds: Count = 5
    width: Count = 64
    depth: Count = 2


class Settings(_Group):
    """One robot's sidecar file. about: why the robot is here and where its values come from.

    gravity: in the frame of the root link [m/s^2]. joints: by URDF name; a joint not listed has the defaults.
    """

    about: str = ""
    gravity: tuple[Number, Number, Number] = (0.0, 0.0, -9.81)
    joints: dict[str, JointSettings] = {}
    simulation: SimulationSettings = SimulationSettings()
    training: TrainingSettings = TrainingSettings()
    comparison: ComparisonSettings = ComparisonSettings()

    def joint(self, name: str) -> JointSettings:
        """Return the settings of a joint, the defaults when the file does not list it."""
        return self.joints.get(name, JointSettings())


GROUPS: Mapping[str, type[BaseModel]] = {
    "joints": JointSettings,
    "simulation": SimulationSettings,
    "training": TrainingSettings,
    "comparison": ComparisonSettings,
}


def load_settings(urdf_path: Path | str) -> Settings:
    """Return the settings beside a URDF (`arm.urdf` -> `arm.yaml`), the defaults when there is no such file.

    Raises SettingsError, told with file, line and key, or SpelgenErrors with all that is wrong in the file.
    """
    path = Path(urdf_path).with_suffix(".yaml")
    if not path.exists():
        misnamed = path.with_suffix(".yml")
        if misnamed.exists():
            raise SettingsError(repr(misnamed.name), file=misnamed, expected=repr(path.name), do="rename it")
        return Settings()
    document = read_document(path)
    content = document.value()
    try:
        return Settings() if content is None else Settings.model_validate(content)
    except ValidationError as error:
        collect([_explain(detail, document) for detail in error.errors(include_url=False)])
        raise


def check_joint_names(settings: Settings, names: Iterable[str], urdf_path: Path | str) -> None:
    """Raise SettingsError when the settings beside this URDF speak of joints that are not among `names`."""
    known = list(names)
    spoken: list[tuple[str, ...]] = [("joints", name) for name in settings.joints]
    spoken += [("simulation", "positions", name) for name in settings.simulation.positions or ()]
    unknown = [location for location in spoken if location[-1] not in known]
    if unknown:
        document = read_document(Path(urdf_path).with_suffix(".yaml"))  # once more, for the lines
        collect([_unknown(location, "joint", known, document) for location in unknown])


def _explain(detail: Mapping[str, Any], document: Document) -> SettingsError:
    location, kind = tuple(detail["loc"]), detail["type"]
    if kind == "extra_forbidden":
        group = GROUPS[str(location[0])] if len(location) > 1 else Settings
        return _unknown(location, "key", list(group.model_fields), document)
    if location[-1:] == ("[key]",):
        location, kind = location[:-1], "key"
    expected = {
        "key": "a name; write it in quotes",
        "model_type": "keys with values",
        "dict_type": "keys with values",
    }.get(kind, detail["msg"].removeprefix("Input should be ").removeprefix("Value error, "))
    got = repr(detail["input"])
    return SettingsError(
        got if len(got) <= 60 else got[:57] + "...",
        file=document.path,
        line=document.line(location),
        element=_dotted(location),
        expected=expected,
    )


def _unknown(location: tuple[Any, ...], kind: str, known: Iterable[str], document: Document) -> SettingsError:
    return SettingsError(
        f"unknown {kind} {str(location[-1])!r}",
        file=document.path,
        line=document.line(location),
        element=_dotted(location[:-1]),
        do=suggestion(str(location[-1]), known),
    )


def _dotted(location: tuple[Any, ...]) -> str | None:
    return ".".join(map(str, location)) or None
