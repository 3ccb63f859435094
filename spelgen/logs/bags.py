"""Read ROS 2 bags (MCAP, sqlite3) by the package `rosbags`: no ROS is needed."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa

from spelgen.errors import LogError, in_one_line
from spelgen.files import limited_memory, require_regular_file
from spelgen.logs.tables import LogFormat, LogTable, table_layout
from spelgen.settings.log_mapping import PLAIN, LogColumns, LogMapping

if TYPE_CHECKING:
    from rosbags.interfaces import Connection
    from rosbags.rosbag2 import Reader

MESSAGE = "sensor_msgs/msg/JointState"
MEMORY = 2**29  # bytes beside what the messages of a bag take
FIELDS = {"q": "position", "qd": "velocity", "tau": "effort"}


def read_bag(path: Path, joints: Sequence[str], mapping: LogMapping) -> list[LogTable]:
    """Return the joint states of a bag, or of a file of its storage, as one table.

    t [s] counts from the first message: by the header's stamps, or by the recorder's clock where the first
    stamp is 0. A message with none of the joints is another device's and passed over. Raises LogError, also where
    `rosbags` is not installed.
    """
    table = _joint_states(path, list(map(mapping.log_name, joints)), mapping.topic)
    # the messages' own fields, in SI units by definition: the mapping says no columns
    mapping = mapping.with_joint_columns(dict.fromkeys(joints, dict.fromkeys(FIELDS)))
    mapping = mapping.model_copy(update={"columns": LogColumns()})
    return [(table_layout(table.schema, joints, mapping, path), table)]


def _joint_states(path: Path, names: Sequence[str], topic: str | None) -> pa.Table:
    """Return the columns `t`, `q_<name>`, `qd_<name>`, `tau_<name>`; none of a field that no message fills."""
    times: list[int] = []
    rows: list[np.ndarray] = []
    other_names: dict[str, None] = {}
    for stamp, state in _messages(path, topic):
        missing = set(names) - set(state.name)
        if len(missing) == len(names):
            other_names |= dict.fromkeys(state.name)
            continue
        number = len(rows) + 1
        if missing:
            raise LogError(
                f"a message with the joints {', '.join(state.name)}", file=path, element=f"message {number}",
                expected=f"{', '.join(sorted(missing, key=names.index))} in it too",
            )  # fmt: skip
        values = np.full((len(FIELDS), len(state.name)), np.nan)  # where the message leaves a field empty
        for k, field in enumerate(FIELDS.values()):
            logged = np.asarray(getattr(state, field), dtype=float)
            if len(logged) not in (0, len(state.name)):
                raise LogError(
                    f"{len(logged)} values for {len(state.name)} joints", file=path,
                    element=f"message {number}, {field}", expected="one of each",
                )  # fmt: skip
            if len(logged):
                values[k] = logged
        times.append(stamp)
        rows.append(values[:, list(map(state.name.index, names))])
    if not rows:
        raise LogError(
            f"joint states of {', '.join(other_names) or 'no joint'} only", file=path,
            expected=", ".join(names), do="map the joints' names under 'logs'",
        )  # fmt: skip
    columns = {"t": (np.array(times) - times[0]) * 1e-9}
    for quantity, by_joint in zip(FIELDS, np.array(rows).transpose(1, 2, 0), strict=True):  # (3, n, T)
        if not np.isnan(by_joint).all():
            for name, values in zip(names, by_joint, strict=True):
                columns[PLAIN[quantity].replace("{joint}", name)] = values
    return pa.table(columns)


def _messages(path: Path, topic: str | None) -> Iterator[tuple[int, Any]]:
    """Yield times [ns] and joint states of one topic.

    Messages are decoded by the published definition of the standard type alone: definitions that come with a
    bag are not looked at.
    """
    try:
        from rosbags.rosbag2 import Reader
        from rosbags.typesys import Stores, get_typestore
    except ModuleNotFoundError as error:
        expected, do = "the package rosbags to read it", "pip install 'spelgen[ros]'"
        raise LogError("a ROS 2 bag", file=path, expected=expected, do=do) from error
    size = path.stat().st_size
    for file in path.rglob("*"):
        if not file.is_dir():
            # rosbags opens whatever the folder holds
            require_regular_file(file, LogError, "files in the folder of a ROS 2 bag")
            size += file.stat().st_size
    store = get_typestore(Stores.ROS2_HUMBLE)
    try:
        # rosbags unpacks a chunk whole, however large it gets; messages as arrays take ten times their bytes
        with limited_memory(MEMORY + 20 * size), Reader(path) as reader:
            by_header = None
            for _, recorded, raw in reader.messages(_connections(reader, topic, path)):
                state: Any = store.deserialize_cdr(raw, MESSAGE)
                clock = state.header.stamp
                stamp = clock.sec * 1_000_000_000 + clock.nanosec
                # one clock for all messages: the two may be hours apart
                if by_header is None:
                    by_header = stamp != 0
                yield stamp if by_header else recorded, state
    except (LogError, GeneratorExit):
        raise
    except Exception as error:  # rosbags, its storages and their decompressors raise many kinds
        reason = in_one_line(error).rstrip(".")
        raise LogError(f"an unreadable ROS 2 bag ({reason})", file=path) from error


def _connections(reader: Reader, topic: str | None, path: Path) -> list[Connection]:
    """Return the connections that carry joint states of the topic, or of the only topic that has them."""
    connections = [x for x in reader.connections if x.msgtype == MESSAGE]
    topics = sorted({x.topic for x in connections})
    if not topics:
        present = sorted({f"{x.topic} ({x.msgtype})" for x in reader.connections})
        got, expected, do = f"only the topics {', '.join(present) or '(none)'}", f"one of {MESSAGE}", None
    elif topic is None and len(topics) > 1:
        got, expected = f"joint states on the topics {', '.join(topics)}", "one of them"
        do = "name it by 'topic' under 'logs'"
    elif topic not in (None, *topics):
        got, expected, do = f"no joint states on {topic}", f"one of {', '.join(topics)}", None
    else:
        return [x for x in connections if topic in (None, x.topic)]
    raise LogError(got, file=path, expected=expected, do=do)


BAG = LogFormat(read_bag, suffixes=(".mcap", ".db3"), marker="metadata.yaml", folder="a ROS 2 bag")
