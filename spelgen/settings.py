"""What a URDF does not say about a robot: the sidecar `rpr.yaml` beside `rpr.urdf`, checked key by key."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from fractions import Fraction
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, get_args

from pydantic import BaseModel, Field, ValidationError, field_validator, model_validator

from spelgen.errors import SettingsError, collect, suggestion
from spelgen.log_mapping import LogMapping
from spelgen.setting_values import Count, Group, NonNegative, Number, Positive, Share, Whole
from spelgen.yaml_document import Document, read_document

Inputs = Annotated[tuple[Number, ...], Field(min_length=1)]
GroupType = TypeVar("GroupType", bound=BaseModel)


class JointSettings(Group):
    """Drive of one joint; N and m in place of Nm and rad when it is prismatic.

    rotor_inertia: of the motor, before the gear [kg m^2]; the joint feels rotor_inertia * gear^2.
    gear: motor turns per joint turn.
    viscous: friction torque per joint velocity, after the gear [Nm s/rad].
    coulomb: friction torque for qd > 0 and for qd < 0, after the gear [Nm], e.g. (0.395, -0.435).
    actuated: False for a passive joint, which never gets an input.
    gain: "trained" where the gear between logged motor torques and the joint is to be learned; it starts at `gear`.
    inputs: the torques it draws from in a simulation, in place of `simulation.inputs` [Nm].
    """

    rotor_inertia: NonNegative = 0.0
    gear: Positive = 1.0
    viscous: NonNegative = 0.0
    coulomb: tuple[Number, Number] = (0.0, 0.0)
    actuated: bool = True
    gain: Literal["known", "trained"] = "known"
    inputs: Inputs | None = None

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
        if not _independent([[Fraction(x) for x in row] for row in self.matrix]):
            raise ValueError("a matrix with an inverse: as many independent motors as joints")
        return self


class SimulationSettings(Group):
    """How `spelgen simulate` makes logs.

    protocol: random-inputs, or tracking: controlled motions, see `TrackingSettings`.
    trajectories: number, each from its own initial position, at rest.
    duration: of each [s]. rate: of samples and of the inputs, which are held in between [Hz].
    inputs: the torques each actuated joint draws from, every sample anew [Nm].
    test_fraction: part of the trajectories kept for testing; with tracking, of each trajectory, its end.
    positions: joint -> (lowest, highest) initial position [rad]; not given: its limits, +-pi if continuous.
    friction_velocity: width of the tanh in place of Coulomb friction's jump [rad/s].
    """

    protocol: Literal["random-inputs", "tracking"] = "random-inputs"
    trajectories: Count = 64
    duration: Positive = 1.0
    rate: Positive = 20.0
    inputs: Inputs = (-2.0, -1.0, 0.0, 1.0, 2.0)
    test_fraction: Share = 0.5
    positions: dict[str, tuple[Number, Number]] | None = None
    friction_velocity: Positive = 0.05
    seed: Whole = 0

    @field_validator("positions")
    @classmethod
    def _ordered(cls, value: dict[str, tuple[float, float]] | None) -> dict[str, tuple[float, float]] | None:
        for name, (lowest, highest) in (value or {}).items():
            if lowest > highest:
                raise ValueError(f"the lowest position of {name!r} first, then the highest")
        return value


class TrackingSettings(Group):
    """How an arm moves and is seen in `simulation.protocol: tracking`.

    amplitude [rad; m], frequency [Hz]: of each joint's sine about the middle of `simulation.positions`.
    paths: "same": all trajectories follow one closed path, each beginning further on; "own": each has phases of
    its own, so that its test part lies where no training part was.
    bandwidths: of the PID controllers of the first, second, ... trajectory, then over again [Hz].
    control: rate of the controllers, which hold their torques; simulation.rate is a multiple of it [Hz].
    resolution: of the encoders [rad; m]. cutoff: of the zero-phase low-pass on their positions [Hz].
    """

    amplitude: Positive = 0.5235987755982988
    frequency: Positive = 0.125
    paths: Literal["same", "own"] = "same"
    bandwidths: Annotated[tuple[Positive, ...], Field(min_length=1)] = (2.0, 2.5, 3.0, 3.5, 4.0, 4.5)
    control: Positive = 125.0
    resolution: Positive = 4.8e-5
    cutoff: Positive = 30.0


class TrainingSettings(Group):
    """Defaults of `spelgen train`; command-line flags override them.

    objective: what is fitted: the torque (the default of closed-form models) or predicted windows.
    window: samples predicted together. stride: samples from the start of one window to the next.
    every: samples from one sample of a window to the next; None: as many as filtered logs can spare.
    batch: windows per step. epochs: passes over all windows, at most.
    patience: epochs without a better validation loss before stopping.
    momentum_steps: steps on the weak form (see `momentum_loss`) before windows are predicted.
    prior: weight of staying near the URDF's own M and gravity (see `Prior`); 0: none.
    optimiser: AdamW on batches or L-BFGS on all windows at once; None: L-BFGS where these are few.
    weight_decay: of AdamW, or the weight of L-BFGS's penalty; None: what suits the optimiser.
    substeps: integrator steps per sample interval; None: as many as the robot needs.
    validation_fraction: part of the training trajectories held out to watch the validation loss.
    """

    objective: Literal["torque", "momentum", "rollout"] | None = None
    momentum_steps: Whole = 2000
    prior: NonNegative = 1.0
    window: Annotated[Count, Field(ge=2)] = 5
    stride: Count = 1
    every: Count | None = None
    epochs: Count = 400
    batch: Count = 256
    learning_rate: Positive = 1e-3
    weight_decay: NonNegative | None = None
    optimiser: Literal["adamw", "lbfgs"] | None = None
    substeps: Count | None = None
    validation_fraction: Annotated[Number, Field(gt=0, lt=1)] = 0.25
    patience: Count = 60
    seed: Whole = 0


class ComparisonSettings(Group):
    """How `spelgen compare` trains every preset on this robot's simulated logs.

    first: only so much of each training trajectory is trained on [s]; None: all. steps: of training, at least.
    momentum_steps: before these. weight_decay: of every preset; None: as in training. seeds: runs of each preset.
    width, depth: of the hidden layers.
    """

    first: Positive | None = None
    steps: Count = 1500
    momentum_steps: Whole = 1000
    weight_decay: NonNegative | None = None
    seeds: Count = 5
    width: Count = 64
    depth: Count = 2


class Settings(Group):
    """One robot's sidecar file. about: why the robot is here and where its values come from.

    gravity: in the frame of the root link [m/s^2]. joints: by URDF name; a joint not listed has the defaults.
    torque: whether the logs' tau are joint torques, or motor torques before the gear. couplings: of motors
    that move several joints, for motor torques. logs: how this robot's logs are named and measured.
    """

    about: str = ""
    torque: Literal["joint", "motor"] = "joint"
    couplings: tuple[Coupling, ...] = ()
    gravity: tuple[Number, Number, Number] = (0.0, 0.0, -9.81)
    joints: dict[str, JointSettings] = Field(default={})
    simulation: SimulationSettings = SimulationSettings()
    tracking: TrackingSettings = TrackingSettings()
    training: TrainingSettings = TrainingSettings()
    comparison: ComparisonSettings = ComparisonSettings()
    logs: LogMapping = LogMapping()

    @model_validator(mode="after")
    def _drives(self) -> Settings:
        if self.couplings and self.torque == "joint":
            raise ValueError("'torque: motor' where there are couplings: joint torques know none")
        coupled = [name for coupling in self.couplings for name in coupling.joints]
        for name in coupled:
            if coupled.count(name) > 1:
                raise ValueError(f"the joint {name!r} once in all couplings")
            if not self.joint(name).actuated:
                raise ValueError(f"the joint {name!r} coupled to motors or 'actuated: false', not both")
        return self

    def joint(self, name: str) -> JointSettings:
        """Return the settings of a joint, the defaults when the file does not list it."""
        return self.joints.get(name, JointSettings())


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
    return _validated(read_document(path), Settings)


def load_mapping(path: Path | str, joints: Iterable[str]) -> LogMapping:
    """Return the mapping of logs in a YAML file of its own: what a sidecar file holds under `logs`.

    Raises SettingsError as `load_settings` does, and for joints that are not among `joints`.
    """
    document, known = read_document(Path(path)), list(joints)
    mapping = _validated(document, LogMapping)
    unknown = [name for name in mapping.joints if name not in known]
    collect([_unknown(("joints", name), "joint", name, known, document) for name in unknown])
    return mapping


def _validated(document: Document, group: type[GroupType]) -> GroupType:
    content = document.value()
    try:
        return group() if content is None else group.model_validate(content)
    except ValidationError as error:
        collect([_explain(detail, document, group) for detail in error.errors(include_url=False)])
        raise


def check_joint_names(settings: Settings, names: Iterable[str], urdf_path: Path | str) -> None:
    """Raise SettingsError when the settings beside this URDF speak of joints that are not among `names`."""
    known = list(names)
    spoken: list[tuple[tuple[Any, ...], str]] = [(("joints", name), name) for name in settings.joints]
    spoken += [(("simulation", "positions", name), name) for name in settings.simulation.positions or ()]
    spoken += [(("logs", "joints", name), name) for name in settings.logs.joints]
    for number, coupling in enumerate(settings.couplings):
        spoken += [(("couplings", number, "joints", at), name) for at, name in enumerate(coupling.joints)]
    unknown = [(location, name) for location, name in spoken if name not in known]
    if unknown:
        document = read_document(Path(urdf_path).with_suffix(".yaml"))  # once more, for the lines
        collect([_unknown(location, "joint", name, known, document) for location, name in unknown])


def _explain(detail: Mapping[str, Any], document: Document, group: type[BaseModel]) -> SettingsError:
    location, kind = tuple(detail["loc"]), detail["type"]
    if kind == "extra_forbidden":
        known = list(_group_at(group, location[:-1]).model_fields)
        return _unknown(location, "key", str(location[-1]), known, document)
    if location[-1:] == ("[key]",):
        location, kind = location[:-1], "key"
    expected = {
        "key": "a name; write it in quotes",
        "model_type": "keys with values",
        "dict_type": "keys with values",
    }.get(kind, detail["msg"].removeprefix("Input should be ").removeprefix("Value error, "))
    got = repr(detail["input"]) if location or kind != "value_error" else "these settings"
    return SettingsError(
        got if len(got) <= 60 else got[:57] + "...",
        file=document.path,
        line=document.line(location),
        element=_dotted(location),
        expected=expected,
    )


def _group_at(group: type[BaseModel], location: tuple[Any, ...]) -> type[BaseModel]:
    """The group of keys at a place in a file; keys of a dict and numbers of a list lead into the next one."""
    for part in location:
        field = group.model_fields.get(str(part))
        group = next(iter(_groups_in(field.annotation)), group) if field else group
    return group


def _groups_in(annotation: Any) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [found for each in get_args(annotation) for found in _groups_in(each)]


def _unknown(
    location: tuple[Any, ...], kind: str, name: str, known: Iterable[str], document: Document
) -> SettingsError:
    return SettingsError(
        f"unknown {kind} {name!r}",
        file=document.path,
        line=document.line(location),
        element=_dotted(location[:-1]),
        do=suggestion(name, known),
    )


def _independent(rows: list[list[Fraction]]) -> bool:
    """Whether a square matrix has an inverse, by elimination, exactly."""
    while rows:
        pivot = next((row for row in rows if row[0]), None)
        if pivot is None:
            return False
        rows.remove(pivot)
        rows = [[b - row[0] / pivot[0] * a for a, b in zip(pivot[1:], row[1:], strict=True)] for row in rows]
    return True


def _dotted(location: tuple[Any, ...]) -> str | None:
    return ".".join(map(str, location)) or None
