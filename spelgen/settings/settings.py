"""Read the settings of a robot, `rpr.yaml` for `rpr.urdf`, and check them key by key.

Some groups of keys, such as `training`, are used by one step only. An error in such a group is raised only when the
group is used.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Sequence
from itertools import chain
from pathlib import Path
from typing import Annotated, Literal, NoReturn

import numpy as np
from pydantic import Field, field_validator, model_validator

from spelgen.errors import Diagnostic, SettingsError, SpelgenError, SpelgenErrors, collect
from spelgen.settings.log_mapping import LogMapping
from spelgen.settings.simulation import SimulationSettings, TrackingSettings
from spelgen.settings.training import ComparisonSettings, TrainingSettings
from spelgen.settings.yaml_document import (
    Group,
    Inputs,
    Location,
    NonNegative,
    Number,
    Positive,
    YamlDocument,
    read_document,
    unknown_name,
    validated,
)

OF_A_STEP = ("simulation", "tracking", "training", "comparison", "logs")
"""Groups of keys that only one step uses, such as simulation or training; all other keys describe the arm."""


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
        # gear^2: the rotor accelerates `gear` times as fast as the joint, and the gear multiplies the torque of the
        # rotor by `gear`.
        return self.rotor_inertia * self.gear**2

    @field_validator("coulomb")
    @classmethod
    def _resists(cls, value: tuple[float, float]) -> tuple[float, float]:
        # A friction coefficient of the wrong sign is an error, because such friction would drive the joint.
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
        # Each row of the matrix is scaled before its rank is tested, because joint torques (rows) may have different
        # units.
        largest = np.abs(rows).max(axis=1, keepdims=True, initial=0.0)
        if np.linalg.matrix_rank(rows / np.where(largest > 0, largest, 1.0)) < len(self.joints):
            raise ValueError("a matrix with an inverse: as many independent motors as joints")
        return self


class Unusable:
    """Placeholder for a group of settings with errors. The errors are raised if an attribute of the group is read."""

    def __init__(self, errors: Sequence[SpelgenError]) -> None:
        self.errors = tuple(errors)

    def __getattr__(self, name: str) -> NoReturn:
        # Python's copy and pickle look for optional methods such as `__deepcopy__`, and expect AttributeError if there
        # is none. Attributes `__pydantic...` are different: pydantic reads them when it reads the values of a group,
        # so that the errors of the group must be raised.
        if not name.startswith("__") or name.startswith("__pydantic"):
            collect(self.errors)
        raise AttributeError(name)


class Settings(Group):
    """Settings of one robot.

    Attributes:
        about: Description of the robot and sources of the values.
        tip: Last link of the arm, as `--tip`; not together with `moving_joints`.
        moving_joints: Names of the moving joints, as `--joints`.
        input: Quantity that commands the joints: joint torques, or positions of servos ("u").
        torque: Torques in the logs: joint torques, or motor torques before the gear.
        couplings: Motors that drive several joints. Their friction and rotor inertia belong to the motors, also if
            joint torques are logged.
        gravity: Gravitational acceleration in the frame of the root link [m/s^2].
        joints: Drives, by the joint's name in the URDF; a joint without settings has the defaults.
        simulation: Simulated logs.
        tracking: Controlled motions of `simulation.protocol: tracking`.
        training: Defaults of `spelgen train`.
        comparison: Training by `spelgen compare`.
        logs: Names, units and signs of logged columns.
    """

    about: str = ""
    tip: str | None = None
    moving_joints: Annotated[tuple[str, ...], Field(min_length=1)] | None = None
    input: Literal["torque", "position"] = "torque"
    torque: Literal["joint", "motor"] = "joint"
    couplings: tuple[MotorCoupling, ...] = ()
    gravity: tuple[Number, Number, Number] = (0.0, 0.0, -9.81)
    joints: dict[str, JointSettings] = Field(default={})
    simulation: SimulationSettings = SimulationSettings()
    tracking: TrackingSettings = TrackingSettings()
    training: TrainingSettings = TrainingSettings()
    comparison: ComparisonSettings = ComparisonSettings()
    logs: LogMapping = LogMapping()

    @field_validator("gravity")
    @classmethod
    def _of_a_planet(cls, value: tuple[float, float, float]) -> tuple[float, float, float]:
        # 981 and 9810 are the gravity of the Earth in cm/s^2 and mm/s^2; the largest one of a planet is 25 m/s^2.
        if max(map(abs, value)) > 100:
            raise ValueError("m/s^2, such as [0, 0, -9.81], and not mm/s^2")
        return value

    @field_validator("joints", mode="before")
    @classmethod
    def _by_name(cls, joints: object) -> object:
        # A list in `joints` is often meant for `moving_joints`. The message of pydantic would not name `moving_joints`.
        if isinstance(joints, list):
            raise ValueError("settings by the name of a joint; `moving_joints` lists the joints that move")
        return joints

    @model_validator(mode="after")
    def _drives(self) -> Settings:
        # `tip` and `moving_joints` both determine the last joint, and could contradict each other.
        if self.tip is not None and self.moving_joints is not None:
            raise ValueError("'tip' or 'moving_joints', not both")
        # `torque: motor` and couplings describe logged torques. Logs of position servos have none, so that one of the
        # settings must be wrong.
        if self.input == "position" and (self.torque == "motor" or self.couplings):
            raise ValueError("'input: position' or 'torque: motor' and couplings, not both")
        # A joint in two couplings would be driven by two different sets of motors.
        coupled = [name for coupling in self.couplings for name in coupling.joints]
        for name in coupled:
            if coupled.count(name) > 1:
                raise ValueError(f"the joint {name!r} once in all couplings")
            if not self.joint(name).actuated:
                raise ValueError(f"the joint {name!r} coupled to motors or 'actuated: false', not both")
        return self

    @property
    def diagnostics(self) -> tuple[Diagnostic, ...]:
        """Warnings about errors in groups of keys that only one step uses, such as `training`: one per error.

        They are warnings because all other steps can use the settings; the step that uses the group raises the errors.
        """
        unusable = [group for _, group in self if isinstance(group, Unusable)]
        errors = [error for group in unusable for error in group.errors]
        return tuple(Diagnostic("warning", "unusable-settings", "settings", None, str(x)) for x in errors)

    def joint(self, name: str) -> JointSettings:
        """Return the settings of the joint of this name; the defaults if the settings file does not list it."""
        return self.joints.get(name, JointSettings())


def load_settings(urdf_path: Path | str, joints: Collection[str] | None = None) -> Settings:
    """Return the settings of a URDF (`arm.yaml` for `arm.urdf`); the defaults if the file does not exist.

    Args:
        urdf_path: Path of the URDF.
        joints: Names of all joints in the URDF; settings of any other joint are errors. None: names are not checked.

    Raises:
        SettingsError, SpelgenErrors: One or several errors, with file, line and key. The errors of a group that only
            one step uses (``OF_A_STEP``), such as `training`, are raised when an attribute of the group is read, so
            that other steps can run.
    """
    path = Path(urdf_path).with_suffix(".yaml")
    if not path.exists():
        # A settings file with the suffix .yml is an error, because it would be ignored silently.
        misnamed = path.with_suffix(".yml")
        if misnamed.exists():
            raise SettingsError(repr(misnamed.name), file=misnamed, expected=repr(path.name), do="rename it")
        return Settings()
    document = read_document(path)
    content = document.value()
    unusable: dict[str, tuple[SpelgenError, ...]] = {}
    while True:
        try:
            settings = validated(Settings, content, document)
            if joints is not None:
                _require_joints(_joint_names(settings), joints, document)
            break
        except SpelgenError as error:
            errors = error.errors if isinstance(error, SpelgenErrors) else (error,)
        # If only one step, such as training, uses a group of keys that has errors, a placeholder replaces the group, so
        # that other steps can run.
        for each in errors:
            group = (each.element or "").partition(".")[0]
            if group not in OF_A_STEP:
                collect([*errors, *chain(*unusable.values())])
            unusable[group] = (*unusable.get(group, ()), each)
            # The loop checks the content again without the faulty group. Other groups may also have errors, which the
            # errors of this group may have hidden.
            content.pop(group, None)
    update: dict[str, object] = {group: Unusable(group_errors) for group, group_errors in unusable.items()}
    # The setting `input` of the arm also applies to its logs, so that a settings file contains it only once.
    if settings.input == "position" and "logs" not in unusable:
        update["logs"] = settings.logs.model_copy(update={"input": "position"})
    return settings.model_copy(update=update)


def load_mapping(path: Path | str, joints: Collection[str]) -> LogMapping:
    """Return the mapping of log columns in a separate YAML file, with the keys of the group `logs` of the settings.

    Raises SettingsError as `load_settings` does, also for joints that are not among `joints`.
    """
    document = read_document(Path(path))
    content = document.value()
    groups = Settings.model_fields.keys() - LogMapping.model_fields
    if isinstance(content, dict) and "logs" in content and content.keys() <= groups | {"joints"}:
        raise SettingsError(
            "settings of a robot", file=document.path, line=document.line(("logs",)),
            expected="the keys of a mapping, as in the group logs of these settings",
            do="write these keys into a file of their own; without --mapping, the settings beside the URDF are used",
        )  # fmt: skip
    mapping = validated(LogMapping, content, document)
    _require_joints(((("joints", name), name) for name in mapping.joints), joints, document)
    return mapping


def _require_joints(
    found: Iterable[tuple[Location, str]], names: Collection[str], document: YamlDocument
) -> None:
    """Raise SettingsError, or SpelgenErrors for several errors, if a joint in a settings file is not among `names`.

    found: (location, name) of each joint in the file. document: the file, for the lines in errors.
    """
    collect([unknown_name(place, "joint", x, names, document) for place, x in found if x not in names])


def _joint_names(settings: Settings) -> Iterator[tuple[Location, str]]:
    """Yield (location in the file, name) of each joint that the settings mention."""
    for name in settings.joints:
        yield ("joints", name), name
    for name in settings.simulation.positions or ():
        yield ("simulation", "positions", name), name
    for name in settings.logs.joints:
        yield ("logs", "joints", name), name
    for number, coupling in enumerate(settings.couplings):
        for index, name in enumerate(coupling.joints):
            yield ("couplings", number, "joints", index), name
