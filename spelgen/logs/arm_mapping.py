"""Determination of the joint names and column mapping of logs from an arm, a model, or a list of joint names."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple, Protocol, runtime_checkable

from spelgen.errors import LogError
from spelgen.settings.log_mapping import LogMapping
from spelgen.settings.settings import Settings, load_mapping
from spelgen.settings.yaml_document import YamlDocument, validated
from spelgen.urdf.robot import Robot

GivenMapping = LogMapping | Mapping[str, object] | Path | str | None


@runtime_checkable
class JointNames(Protocol):
    """Protocol of an object with the names and types of a log's joints: an arm or a trained model.

    joint_types: "revolute" or "prismatic" for each joint.
    """

    @property
    def joint_names(self) -> Sequence[str]: ...
    @property
    def joint_types(self) -> Sequence[str]: ...


@runtime_checkable
class DescribedArm(Protocol):
    """Protocol of a loaded arm (see `load_arm`), whose settings contain the column mapping of its logs.

    turning_joints: names of the revolute joints without position limits, or with limits more than two turns apart.
    """

    @property
    def chain(self) -> JointNames: ...
    @property
    def turning_joints(self) -> Sequence[str]: ...
    @property
    def robot(self) -> Robot: ...
    @property
    def settings(self) -> Settings: ...


@runtime_checkable
class DrivenModel(Protocol):
    """Protocol of a model that states which input drives its joints: "torque", or "position" for servos."""

    @property
    def input_quantity(self) -> str: ...


LoggedArm = DescribedArm | JointNames | Sequence[str]


class LogSource(NamedTuple):
    """Joints of logs, and the mapping of the logs' columns to the signals of these joints.

    joint_types: "revolute" or "prismatic" for each joint; None if the types are unknown.
    """

    joints: tuple[str, ...]
    joint_types: tuple[str, ...] | None
    mapping: LogMapping


def log_source(arm: LoggedArm, mapping: GivenMapping = None) -> LogSource:
    """Return the joints of logs and the mapping of the logs' columns; for the arguments see `read_logs`.

    Raises LogError if `arm` has a wrong type, SettingsError for a wrong mapping.
    """
    if isinstance(arm, DescribedArm):
        stated = arm.settings.logs
        log_mapping = stated if mapping is None else _mapping(mapping, list(arm.robot.joint), stated)
        if arm.settings.input == "position":
            log_mapping = log_mapping.model_copy(update={"input": "position"})
        # Joints without limits may be logged as angles within one turn, so the wraps of their angles are removed.
        log_mapping = log_mapping.with_turns(arm.turning_joints)
        return LogSource(tuple(arm.chain.joint_names), tuple(arm.chain.joint_types), log_mapping)
    if isinstance(arm, JointNames):
        joints = tuple(arm.joint_names)
        log_mapping = _mapping(mapping, joints)
        if isinstance(arm, DrivenModel) and arm.input_quantity == "position":
            log_mapping = log_mapping.model_copy(update={"input": "position"})
        return LogSource(joints, tuple(arm.joint_types), log_mapping)
    if isinstance(arm, Sequence) and not isinstance(arm, str) and all(isinstance(x, str) for x in arm):
        return LogSource(tuple(arm), None, _mapping(mapping, arm))
    expected = "an arm of load_arm, a model, or joint names in a list"
    raise LogError(repr(arm), element="read_logs", expected=expected)


def _mapping(mapping: GivenMapping, joints: Sequence[str], stated: LogMapping | None = None) -> LogMapping:
    """Return the LogMapping for the argument `mapping` of `read_logs`: a LogMapping, a dict, or a file.

    stated: mapping in the arm's settings, which applies to all keys that the dict or the file does not contain.
    """
    # A LogMapping replaces the mapping in the settings completely. A file or a dict overrides single keys of it.
    if isinstance(mapping, LogMapping):
        return mapping
    if isinstance(mapping, str | Path):
        override = load_mapping(mapping, joints)
    else:
        override = validated(LogMapping, dict(mapping or {}), YamlDocument(Path("mapping"), None))
    if stated is None:
        return override
    return LogMapping.model_validate(
        _merged(stated.model_dump(exclude_unset=True), override.model_dump(exclude_unset=True))
    )


def _merged(stated: object, override: object) -> object:
    """Return the union of two nested dicts of settings; a key in both dicts has the value of `override`."""
    if isinstance(stated, Mapping) and isinstance(override, Mapping):
        return {**stated, **{key: _merged(stated.get(key), value) for key, value in override.items()}}
    return override
