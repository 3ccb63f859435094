"""What a URDF does not say about a robot: the sidecar `rpr.yaml` beside `rpr.urdf`, checked key by key."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import yaml
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, field_validator

from spelgen.errors import SettingsError, collect

MAX_BYTES = 256 * 1024  # 300 joints, each with every key, take 60 kB
MAX_DEPTH = 16


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
    substeps: integrator steps per sample interval.
    validation_fraction: part of the training trajectories held out to watch the validation loss.
    """

    objective: Literal["rollout"] = "rollout"
    window: Annotated[Count, Field(ge=2)] = 5
    stride: Count = 1
    epochs: Count = 400
    batch: Count = 256
    learning_rate: Positive = 1e-3
    weight_decay: NonNegative = 1e-4
    substeps: Count = 4
    validation_fraction: Fraction = 0.25
    patience: Count = 60
    seed: Seed = 0


class Settings(_Group):
    """One robot's sidecar file. about: why the robot is here and where its values come from.

    gravity: in the frame of the root link [m/s^2]. joints: by URDF name; a joint not listed has the defaults.
    """

    about: str = ""
    gravity: tuple[Number, Number, Number] = (0.0, 0.0, -9.81)
    joints: dict[str, JointSettings] = {}
    simulation: SimulationSettings = SimulationSettings()
    training: TrainingSettings = TrainingSettings()

    def joint(self, name: str) -> JointSettings:
        """Return the settings of a joint, the defaults when the file does not list it."""
        return self.joints.get(name, JointSettings())


GROUPS: Mapping[str, type[BaseModel]] = {
    "joints": JointSettings,
    "simulation": SimulationSettings,
    "training": TrainingSettings,
}


def load_settings(urdf_path: Path | str) -> Settings:
    """Return the settings beside a URDF (`arm.urdf` -> `arm.yaml`), the defaults when there is no such file.

    Raises SettingsError, told with file, line and key; every wrong key of the file is told at once.
    """
    path = _sidecar(urdf_path)
    if not path.exists():
        misnamed = path.with_suffix(".yml")
        if misnamed.exists():
            raise SettingsError(repr(misnamed.name), file=misnamed, expected=repr(path.name), do="rename it")
        return Settings()
    root = _compose(path)
    if root is None:
        return Settings()
    try:
        return Settings.model_validate(_construct(root, path))
    except ValidationError as error:
        collect([_explain(detail, root, path) for detail in error.errors(include_url=False)])
        raise


def check_joint_names(settings: Settings, names: Iterable[str], urdf_path: Path | str) -> None:
    """Raise SettingsError when the sidecar of this URDF speaks of joints that are not among `names`."""
    known = list(names)
    spoken: list[tuple[str, ...]] = [("joints", name) for name in settings.joints]
    spoken += [("simulation", "positions", name) for name in settings.simulation.positions or ()]
    unknown = [location for location in spoken if location[-1] not in known]
    if not unknown:
        return
    path = _sidecar(urdf_path)
    root = _compose(path) if path.exists() else None  # read again, for the lines
    file = path if path.exists() else None
    collect([_unknown(location, "joint", known, _line(root, location), file) for location in unknown])


def _sidecar(urdf_path: Path | str) -> Path:
    return Path(urdf_path).with_suffix(".yaml")


class _Loader(yaml.SafeLoader):
    """The safe loader, which also refuses what turns a small file into a huge or an ambiguous one."""

    depth = 0

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node:
        if self.check_event(yaml.AliasEvent):
            raise yaml.composer.ComposerError(None, None, "an alias", self.peek_event().start_mark)
        self.depth += 1
        if self.depth > MAX_DEPTH:
            mark = self.peek_event().start_mark
            raise yaml.composer.ComposerError(None, None, f"more than {MAX_DEPTH} nested levels", mark)
        node = super().compose_node(parent, index)
        self.depth -= 1
        return node

    def compose_mapping_node(self, anchor: Any) -> yaml.Node:
        node = super().compose_mapping_node(anchor)
        seen: set[str] = set()
        for key, _ in node.value:
            if not isinstance(key, yaml.ScalarNode):
                raise yaml.composer.ComposerError(None, None, "a key that is no plain word", key.start_mark)
            if key.value in seen:
                raise yaml.composer.ComposerError(None, None, f"key {key.value!r} twice", key.start_mark)
            seen.add(key.value)
        return node


def _compose(path: Path) -> yaml.Node | None:
    try:
        with path.open("rb") as file:
            data = file.read(MAX_BYTES + 1)
        if len(data) > MAX_BYTES:
            raise SettingsError(f"more than {MAX_BYTES} bytes", file=path, expected="a short settings file")
        return _Loader(data.decode("utf-8")).get_single_node()
    except OSError as error:
        raise SettingsError(f"cannot be read ({error.strerror})", file=path) from error
    except UnicodeDecodeError as error:
        raise SettingsError("bytes that are not UTF-8", file=path, expected="YAML text") from error
    except yaml.YAMLError as error:
        raise _yaml_error(error, path) from error


def _construct(root: yaml.Node, path: Path) -> Any:
    try:
        return yaml.SafeLoader("").construct_document(root)
    except yaml.YAMLError as error:
        raise _yaml_error(error, path) from error
    except ValueError as error:  # e.g. the timestamp 2025-99-99
        raise SettingsError(str(error), file=path, expected="plain YAML values") from error


def _yaml_error(error: yaml.YAMLError, path: Path) -> SettingsError:
    mark = getattr(error, "problem_mark", None)
    problem = getattr(error, "problem", None) or "characters that YAML does not allow"
    return SettingsError(problem, file=path, line=mark.line + 1 if mark else None, expected="plain YAML")


def _explain(detail: Mapping[str, Any], root: yaml.Node, path: Path) -> SettingsError:
    location, kind = tuple(detail["loc"]), detail["type"]
    if kind == "extra_forbidden":
        group = GROUPS[str(location[0])] if len(location) > 1 else Settings
        return _unknown(location, "key", list(group.model_fields), _line(root, location), path)
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
        file=path,
        line=_line(root, location),
        element=_dotted(location),
        expected=expected,
    )


def _unknown(
    location: tuple[Any, ...], kind: str, known: list[str], line: int | None, file: Path | None
) -> SettingsError:
    close = difflib.get_close_matches(str(location[-1]), known, n=1)
    return SettingsError(
        f"unknown {kind} {str(location[-1])!r}",
        file=file,
        line=line,
        element=_dotted(location[:-1]),
        expected="one of " + ", ".join(known),
        do=f"did you mean {close[0]!r}?" if close else None,
    )


def _dotted(location: tuple[Any, ...]) -> str | None:
    return ".".join(map(str, location)) or None


def _line(node: yaml.Node | None, location: tuple[Any, ...]) -> int | None:
    """Line of the deepest node on the way to a location: of the key in a mapping, of the item in a list."""
    line = None if node is None else node.start_mark.line + 1
    for part in location:
        if isinstance(node, yaml.MappingNode):
            found = [(key, value) for key, value in node.value if key.value == str(part)]
        elif isinstance(node, yaml.SequenceNode) and isinstance(part, int) and part < len(node.value):
            found = [(node.value[part], node.value[part])]
        else:
            found = []
        if not found:
            break
        line, node = found[0][0].start_mark.line + 1, found[0][1]
    return line
