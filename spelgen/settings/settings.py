"""What a URDF does not say about a robot: the sidecar `rpr.yaml` beside `rpr.urdf`, checked key by key."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any, Literal, TypeVar

from pydantic import BaseModel, Field, ValidationError, model_validator

from spelgen.errors import SettingsError, collect
from spelgen.logs.mapping import LogMapping
from spelgen.settings.comparison import ComparisonSettings
from spelgen.settings.joint import Coupling, JointSettings
from spelgen.settings.messages import explain, unknown_name
from spelgen.settings.simulation import SimulationSettings, TrackingSettings
from spelgen.settings.training import TrainingSettings
from spelgen.settings.values import Group, Number
from spelgen.settings.yaml_document import Document, read_document

GroupType = TypeVar("GroupType", bound=BaseModel)


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
    collect([unknown_name(("joints", name), "joint", name, known, document) for name in unknown])
    return mapping


def _validated(document: Document, group: type[GroupType]) -> GroupType:
    content = document.value()
    try:
        return group() if content is None else group.model_validate(content)
    except ValidationError as error:
        collect([explain(detail, document, group) for detail in error.errors(include_url=False)])
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
        collect([unknown_name(location, "joint", name, known, document) for location, name in unknown])
