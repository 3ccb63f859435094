"""Read data sets of LeRobot 3: Parquet files of episodes, and their own names of joints."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from spelgen.errors import LogError
from spelgen.files import read_json, require_regular_file
from spelgen.logs.parquet_files import read_parquet
from spelgen.logs.tables import LogFormat, LogTable
from spelgen.settings.log_mapping import LogMapping

INFO = "meta/info.json"
STATE, ACTION = "observation.state", "action"
ENDING = ".pos"


def read_dataset(folder: Path, joints: Sequence[str], mapping: LogMapping) -> list[LogTable]:
    """Return the tables of all files. Raises LogError where there are none, or a joint is not among the motors."""
    mapping = dataset_mapping(folder, joints, mapping)
    tables: list[LogTable] = []
    for file in sorted((folder / "data").rglob("*.parquet")):
        require_regular_file(file, LogError, "files of episodes")
        tables += read_parquet(file, joints, mapping)
    if not tables:
        raise LogError(
            "a data set without Parquet files", file=folder, expected="data/chunk-000/file-000.parquet"
        )
    return tables


def dataset_mapping(folder: Path, joints: Sequence[str], mapping: LogMapping) -> LogMapping:
    """Return the mapping with the columns that the data set's names of motors say: positions, commands, episodes.

    Units stay the mapping's. Raises LogError where a joint is not among these names.
    """
    states, actions = _motor_names(folder, STATE), _motor_names(folder, ACTION)
    columns: dict[str, dict[str, str | None]] = {}
    for joint in joints:
        name = mapping.log_name(joint)
        for names in (states, actions):
            if name not in names:
                raise LogError(
                    f"the motors {', '.join(names) or 'without names'}", file=folder / INFO, element=f"joint {joint}",
                    expected=f"{name} among them", do="write its name under 'logs', 'joints' in the robot's YAML",
                )  # fmt: skip
        q, u = f"{STATE}[{states.index(name)}]", f"{ACTION}[{actions.index(name)}]"
        columns[joint] = {"q": q, "u": u}
    common = mapping.columns.model_copy(update={"t": "timestamp", "trajectory": "episode_index"})
    return mapping.with_joint_columns(columns).model_copy(update={"columns": common})


def _motor_names(folder: Path, feature: str) -> list[str]:
    """Return the motors' names of a feature, without LeRobot's ending."""
    try:
        info = read_json(folder / INFO, LogError)
        groups = info["features"][feature]["names"]
        if not isinstance(groups, dict):
            groups = {"motors": groups or []}  # LeRobot writes a list, or a group of lists
        motors: list[str] = []
        for names in groups.values():
            motors += [str(name).removesuffix(ENDING) for name in names]
        return motors
    except (KeyError, TypeError, AttributeError) as error:
        raise LogError(
            f"no names of {feature} ({type(error).__name__})", file=folder / INFO,
            expected='"features", with the motors\' "names", as LeRobot 3 writes them',
        ) from error  # fmt: skip


LEROBOT = LogFormat(read_dataset, marker=INFO, folder="a LeRobot data set")
