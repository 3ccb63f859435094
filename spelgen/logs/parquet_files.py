"""Read Parquet logs, the columns that are asked for and no others, and data sets of LeRobot 3, made of such files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet

from spelgen.errors import LogError
from spelgen.files import read_json, require_regular_file
from spelgen.logs.tables import LogFormat, LogTable, reading, stored_columns, table_layout
from spelgen.settings.log_mapping import LogMapping

INFO = "meta/info.json"  # of a data set of LeRobot
STATE, ACTION = "observation.state", "action"


def read_parquet(file: Path, joints: Sequence[str], mapping: LogMapping) -> list[LogTable]:
    """Return the one table of a file. A file that spelgen wrote is read as such, whatever the mapping says."""
    schema = pa.parquet.read_schema(file)
    layout = table_layout(schema, joints, mapping, file)
    columns = stored_columns(layout, schema.names)
    # pre-buffering would hold the compressed file in memory beside the table
    return [(layout, pa.parquet.read_table(file, columns=columns, pre_buffer=False))]


def read_dataset(folder: Path, joints: Sequence[str], mapping: LogMapping) -> list[LogTable]:
    """Return the tables of all files, with columns by the data set's names of motors; units stay the mapping's.

    Raises LogError where there are no files, or a joint is not among the motors.
    """
    states, actions = _motor_names(folder, STATE), _motor_names(folder, ACTION)
    for joint in joints:
        name = mapping.log_name(joint)
        for names in (states, actions):
            if name not in names:
                raise LogError(
                    f"the motors {', '.join(names) or 'without names'}", file=folder / INFO, element=f"joint {joint}",
                    expected=f"{name} among them", do="write its name under 'logs', 'joints' in the robot's YAML",
                )  # fmt: skip
        motors = {"q": f"{STATE}[{states.index(name)}]", "u": f"{ACTION}[{actions.index(name)}]"}
        mapping = mapping.with_joint_columns({joint: motors})
    common = mapping.columns.model_copy(update={"t": "timestamp", "trajectory": "episode_index"})
    mapping = mapping.model_copy(update={"columns": common})
    tables: list[LogTable] = []
    for file in sorted((folder / "data").rglob("*.parquet")):
        require_regular_file(file, LogError, "files of episodes")
        with reading(file):
            for layout, table in read_parquet(file, joints, mapping):
                tables.append((replace(layout, file=folder), table))
    if not tables:
        expected = "data/chunk-000/file-000.parquet"
        raise LogError("a data set without Parquet files", file=folder, expected=expected)
    return tables


def _motor_names(folder: Path, feature: str) -> list[str]:
    """Return the motors' names of a feature, without LeRobot's ending."""
    try:
        names = read_json(folder / INFO, LogError)["features"][feature]["names"] or []
        if isinstance(names, dict):  # LeRobot writes a list, or a group of lists
            names = chain(*names.values())
        return [str(name).removesuffix(".pos") for name in names]
    except (KeyError, TypeError, AttributeError) as error:
        raise LogError(
            f"no names of {feature} ({type(error).__name__})", file=folder / INFO,
            expected='"features", with the motors\' "names", as LeRobot 3 writes them',
        ) from error  # fmt: skip


PARQUET = LogFormat(read_parquet, suffixes=(".parquet",), columns=pa.parquet.read_table)
LEROBOT = LogFormat(read_dataset, marker=INFO, folder="a LeRobot data set")
