"""Find out whose logs are read, and how they are named: from an arm, a model or names of joints."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple, Protocol, runtime_checkable

from spelgen.errors import LogError
from spelgen.settings.log_mapping import LogMapping
from spelgen.settings.messages import validated
from spelgen.settings.settings import Settings, load_mapping
from spelgen.settings.yaml_document import Document
from spelgen.urdf.robot import Robot

GivenMapping = LogMapping | Mapping[str, object] | Path | str | None


@runtime_checkable
class JointNames(Protocol):
    """Hold the joints whose logs are read, as an arm and a module do. joint_types: "revolute" or "prismatic"."""

    @property
    def joint_names(self) -> Sequence[str]: ...
    @property
    def joint_types(self) -> Sequence[str]: ...


@runtime_checkable
class DescribedArm(Protocol):
    """Hold what of a loaded arm says how its logs are named."""

    @property
    def arm(self) -> JointNames: ...
    @property
    def robot(self) -> Robot: ...
    @property
    def settings(self) -> Settings: ...


@runtime_checkable
class DrivenModel(Protocol):
    """A model, which states the quantity of its inputs: "torque" or "position"."""

    @property
    def input_quantity(self) -> str: ...


LoggedArm = DescribedArm | JointNames | Sequence[str]


class LogSource(NamedTuple):
    """Say whose logs they are. joint_types: "revolute" or "prismatic", None where they are not known."""

    joints: tuple[str, ...]
    joint_types: tuple[str, ...] | None
    mapping: LogMapping


def log_source(arm: LoggedArm, mapping: GivenMapping = None) -> LogSource:
    """Return what `read_logs` was given. Raises LogError for what is no arm, SettingsError for a wrong mapping."""
    if isinstance(arm, DescribedArm):
        mapping = arm.settings.logs if mapping is None else mapping
        log_mapping = _mapping(mapping, list(arm.robot.joint))
        return LogSource(tuple(arm.arm.joint_names), tuple(arm.arm.joint_types), log_mapping)
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


def _mapping(mapping: GivenMapping, joints: Sequence[str]) -> LogMapping:
    if isinstance(mapping, LogMapping):
        return mapping
    if isinstance(mapping, str | Path):
        return load_mapping(mapping, joints)
    return validated(LogMapping, dict(mapping or {}), Document(Path("mapping"), None))
