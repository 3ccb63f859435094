"""Data sets of LeRobot 3 (a folder with meta/info.json, and Parquet under data/) -> where an arm stands in them."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from spelgen.errors import LogError
from spelgen.settings.log_mapping import LogMapping

INFO = "meta/info.json"
STATE, ACTION = "observation.state", "action"
ENDING = ".pos"


def is_dataset(path: Path) -> bool:
    """Whether this is such a folder."""
    return (path / INFO).is_file()


def dataset_files(path: Path) -> list[Path]:
    """Its files of episodes, in order. Raises LogError where there are none."""
    found = sorted((path / "data").rglob("*.parquet"))
    if not found:
        raise LogError(
            "a data set without Parquet files", file=path, expected="data/chunk-000/file-000.parquet"
        )
    return found


def dataset_mapping(path: Path, joints: Sequence[str], mapping: LogMapping) -> LogMapping:
    """The mapping, with the columns that the data set's own names of motors say: positions, commands, episodes.

    Units stay the mapping's. Raises LogError where a joint is not among these names.
    """
    state, action = (_names(path, feature) for feature in (STATE, ACTION))
    places: dict[str, Any] = {}
    for joint in joints:
        named = mapping.log_name(joint)
        for names in (state, action):
            if named not in names:
                raise LogError(
                    f"the motors {', '.join(names) or 'without names'}", file=path / INFO, element=f"joint {joint}",
                    expected=f"{named} among them", do="say its name under 'logs', 'joints' in the robot's YAML",
                )  # fmt: skip
        columns = {"q": f"{STATE}[{state.index(named)}]", "u": f"{ACTION}[{action.index(named)}]"}
        own = mapping.joint(joint)
        places[joint] = own.model_copy(update={"columns": own.columns.model_copy(update=columns)})
    columns = {"t": "timestamp", "trajectory": "episode_index"}
    whole = mapping.columns.model_copy(update=columns)
    return mapping.model_copy(update={"columns": whole, "joints": places})


def _names(path: Path, feature: str) -> list[str]:
    """Of the motors of a feature, without LeRobot's ending; they stand in a list, or in a group of lists."""
    try:
        found = json.loads((path / INFO).read_text(encoding="utf-8"))["features"][feature]["names"]
        several = list(found.values()) if isinstance(found, dict) else [found or []]
        return [str(name).removesuffix(ENDING) for names in several for name in names]
    except (ValueError, KeyError, TypeError, AttributeError, OSError, RecursionError) as error:
        raise LogError(
            f"no names of {feature} ({type(error).__name__})", file=path / INFO,
            expected='"features", with the motors\' "names", as LeRobot 3 writes them',
        ) from error  # fmt: skip
