"""Whose logs are read, and how these are named: from an arm, a model or names to joints, types and a mapping."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from pydantic import ValidationError

from spelgen.errors import LogError, collect
from spelgen.settings.log_mapping import LogMapping
from spelgen.settings.messages import explain
from spelgen.settings.settings import load_mapping
from spelgen.settings.yaml_document import Document
from spelgen.spec import logged_joints

GivenMapping = LogMapping | Mapping[str, Any] | Path | str | None


class LogSource(NamedTuple):
    """joint_types: "revolute" or "prismatic", None where they are not known."""

    joints: tuple[str, ...]
    joint_types: tuple[str, ...] | None
    mapping: LogMapping


def log_source(arm: Any, mapping: GivenMapping = None) -> LogSource:
    """What `read_logs` was given. Raises LogError for what is no arm, SettingsError for a wrong mapping."""
    if hasattr(arm, "arm") and hasattr(arm, "settings"):
        coordinates = arm.arm.coordinates
        given = arm.settings.logs if mapping is None else mapping
        known = [joint.name for joint in arm.robot.joints]
        names, kinds = tuple(c.name for c in coordinates), tuple(c.kind for c in coordinates)
        return LogSource(names, kinds, _mapping(given, known))
    if hasattr(arm, "joint_names"):
        names = logged_joints(arm)
        return LogSource(names, tuple(arm.joint_types), _mapping(mapping, names))
    if isinstance(arm, Sequence) and not isinstance(arm, str) and all(isinstance(x, str) for x in arm):
        return LogSource(tuple(arm), None, _mapping(mapping, arm))
    raise LogError(
        repr(arm), element="read_logs", expected="an arm of load_arm, a model, or joint names in a list"
    )


def _mapping(given: Any, joints: Sequence[str]) -> LogMapping:
    if isinstance(given, Mapping):
        try:
            return LogMapping.model_validate(dict(given))
        except ValidationError as error:
            keys = Document(Path("mapping"), None)
            collect([explain(each, keys, LogMapping) for each in error.errors(include_url=False)])
    if isinstance(given, str | Path):
        return load_mapping(given, joints)
    return LogMapping() if given is None else given
