"""What a URDF does not say about a robot: the sidecar `rpr.yaml` beside `rpr.urdf`, checked key by key.

A group of keys that one step alone reads refuses that step alone.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, field_validator, model_validator

from spelgen.errors import Diagnostic, SettingsError, SpelgenError, SpelgenErrors, collect
from spelgen.settings.comparison import ComparisonSettings
from spelgen.settings.joint import Coupling, JointSettings
from spelgen.settings.log_mapping import LogMapping
from spelgen.settings.messages import unknown_name, validated
from spelgen.settings.simulation import SimulationSettings, TrackingSettings
from spelgen.settings.training import TrainingSettings
from spelgen.settings.values import Group, Number
from spelgen.settings.yaml_document import Document, Location, read_document

OF_A_STEP = ("simulation", "tracking", "training", "comparison", "logs")
"""Groups that one step reads; all others belong to the arm."""


class Unusable:
    """Stand in the place of a group that cannot be read: whoever reads it gets the errors."""

    def __init__(self, errors: Sequence[SpelgenError]) -> None:
        self.errors = tuple(errors)

    def __getattr__(self, name: str) -> Any:
        if not name.startswith("__"):
            collect(self.errors)
        raise AttributeError(name)


class Settings(Group):
    """One robot's sidecar file. about: why the robot is here and where its values come from.

    gravity: in the frame of the root link [m/s^2]. joints: by URDF name; a joint not listed has the defaults.
    tip, moving_joints: what `--tip` and `--joints` say, so that no command has to repeat it; one of the two.
    input: what commands the joints and is logged: torques, or positions ("u") of servos that hold them like springs.
    torque: whether the logs' tau are joint torques, or motor torques before the gear. couplings: of motors that move
    several joints: their friction and rotors belong to the motors, whatever the logged torques are.
    logs: how this robot's logs are named and measured.
    """

    about: str = ""
    tip: str | None = None
    moving_joints: Annotated[tuple[str, ...], Field(min_length=1)] | None = None
    input: Literal["torque", "position"] = "torque"
    torque: Literal["joint", "motor"] = "joint"
    couplings: tuple[Coupling, ...] = ()
    gravity: tuple[Number, Number, Number] = (0.0, 0.0, -9.81)
    joints: dict[str, JointSettings] = Field(default={})
    simulation: SimulationSettings = SimulationSettings()
    tracking: TrackingSettings = TrackingSettings()
    training: TrainingSettings = TrainingSettings()
    comparison: ComparisonSettings = ComparisonSettings()
    logs: LogMapping = LogMapping()

    @field_validator("joints", mode="before")
    @classmethod
    def _by_name(cls, joints: object) -> object:
        if isinstance(joints, list):
            raise ValueError("settings by the name of a joint; `moving_joints` lists the joints that move")
        return joints

    @model_validator(mode="after")
    def _drives(self) -> Settings:
        if self.tip is not None and self.moving_joints is not None:
            raise ValueError("'tip' or 'moving_joints', not both")
        if self.input == "position" and (self.torque == "motor" or self.couplings):
            raise ValueError("'input: position' or 'torque: motor' and couplings, not both")
        coupled = [name for coupling in self.couplings for name in coupling.joints]
        for name in coupled:
            if coupled.count(name) > 1:
                raise ValueError(f"the joint {name!r} once in all couplings")
            if not self.joint(name).actuated:
                raise ValueError(f"the joint {name!r} coupled to motors or 'actuated: false', not both")
        return self

    @property
    def diagnostics(self) -> tuple[Diagnostic, ...]:
        """Return warnings of groups that cannot be read: the steps that need them will stop."""
        diagnostics = []
        for name in OF_A_STEP:
            group = getattr(self, name)
            for error in group.errors if isinstance(group, Unusable) else ():
                diagnostics.append(Diagnostic("warning", "unusable-settings", "settings", None, str(error)))
        return tuple(diagnostics)

    def joint(self, name: str) -> JointSettings:
        """Return the settings of a joint, the defaults when the file does not list it."""
        return self.joints.get(name, JointSettings())


def load_settings(urdf_path: Path | str, joints: Iterable[str] | None = None) -> Settings:
    """Return the settings beside a URDF (`arm.urdf` -> `arm.yaml`), the defaults when there is no such file.

    ``joints``: all that the URDF has; then unknown names are wrong too. Raises SettingsError, told with file,
    line and key, or SpelgenErrors with all that is wrong in the file; a group that one step alone reads
    (``OF_A_STEP``) raises them when it is read.
    """
    path = Path(urdf_path).with_suffix(".yaml")
    if not path.exists():
        misnamed = path.with_suffix(".yml")
        if misnamed.exists():
            raise SettingsError(repr(misnamed.name), file=misnamed, expected=repr(path.name), do="rename it")
        return Settings()
    document = read_document(path)
    content = document.value()
    joint_names = None if joints is None else list(joints)
    unusable: dict[str, Unusable] = {}
    while True:
        try:
            settings = _read(document, content, joint_names).model_copy(update=unusable)
            break
        except SpelgenError as error:
            errors = error.errors if isinstance(error, SpelgenErrors) else (error,)
        # a group that one step reads must not stop the others: it is taken out, and told when it is read
        for wrong in errors:
            group = (wrong.element or "").partition(".")[0]
            if group not in OF_A_STEP:
                collect([*errors, *(x for other in unusable.values() for x in other.errors)])
            earlier = unusable.get(group, Unusable(()))
            unusable[group] = Unusable((*earlier.errors, wrong))
            content.pop(group, None)
    # the arm says once what it is commanded by; its logs follow
    if settings.input == "position" and not isinstance(settings.logs, Unusable):
        logs = settings.logs.model_copy(update={"input": "position"})
        settings = settings.model_copy(update={"logs": logs})
    return settings


def load_mapping(path: Path | str, joints: Iterable[str]) -> LogMapping:
    """Return the mapping of logs in a YAML file of its own: what a sidecar file holds under `logs`.

    Raises SettingsError as `load_settings` does, and for joints that are not among `joints`.
    """
    document, joint_names = read_document(Path(path)), list(joints)
    mapping = validated(LogMapping, document.value(), document)
    unknown = [name for name in mapping.joints if name not in joint_names]
    collect([unknown_name(("joints", name), "joint", name, joint_names, document) for name in unknown])
    return mapping


def _read(document: Document, content: object, joint_names: list[str] | None) -> Settings:
    """Return the settings in ``content``. Raises what `validated` raises, and SettingsError for unknown joints."""
    settings = validated(Settings, content, document)
    if joint_names is not None:
        unknown = [(place, name) for place, name in _joint_names(settings) if name not in joint_names]
        collect([unknown_name(place, "joint", name, joint_names, document) for place, name in unknown])
    return settings


def _joint_names(settings: Settings) -> Iterator[tuple[Location, str]]:
    """Yield the places in a file that name a joint, and the names."""
    for name in settings.joints:
        yield ("joints", name), name
    for name in settings.simulation.positions or ():
        yield ("simulation", "positions", name), name
    for name in settings.logs.joints:
        yield ("logs", "joints", name), name
    for number, coupling in enumerate(settings.couplings):
        for index, name in enumerate(coupling.joints):
            yield ("couplings", number, "joints", index), name
