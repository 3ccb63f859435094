"""Read ROS 2 bags (MCAP, sqlite3) by the package `rosbags`: no ROS is needed."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import numpy as np
import pyarrow as pa

from spelgen.errors import LogError, in_one_line
from spelgen.files import limited_memory, require_regular_file
from spelgen.logs.tables import LogFormat, LogTable, table_layout
from spelgen.settings.log_mapping import PLAIN, LogColumns, LogMapping

if TYPE_CHECKING:
    from rosbags.interfaces import Connection
    from rosbags.rosbag2 import Reader

SUFFIXES = (".mcap", ".db3")
MESSAGE = "sensor_msgs/msg/JointState"
MEMORY = 2**29  # bytes beside what the messages of a bag take
FIELDS = {"q": "position", "qd": "velocity", "tau": "effort"}


class JointState(Protocol):
    """Hold what a `sensor_msgs/msg/JointState` does."""

    name: list[str]
    position: np.ndarray
    velocity: np.ndarray
    effort: np.ndarray


def is_bag(folder: Path) -> bool:
    """Whether a folder is a bag: rosbag2 writes this file into each."""
    return (folder / "metadata.yaml").is_file()


def read_bag(path: Path, joints: Sequence[str], mapping: LogMapping) -> list[LogTable]:
    """Return the joint states of a bag, or of a file of its storage, as one table.

    t [s] counts from the first message: by the header's stamps, or by the recorder's clock where the first
    stamp is 0. A message with none of the joints is another device's and passed over. Raises LogError, also where
    `rosbags` is not installed.
    """
    names = [mapping.log_name(joint) for joint in joints]
    table = _joint_states(path, names, mapping.topic)
    # the messages' own fields, in SI units by definition: the mapping says no columns
    mapping = mapping.with_joint_columns(dict.fromkeys(joints, dict.fromkeys(FIELDS)))
    mapping = mapping.model_copy(update={"columns": LogColumns()})
    return [LogTable(None, table, table_layout(table.schema, joints, mapping, path))]


def _joint_states(path: Path, names: Sequence[str], topic: str | None) -> pa.Table:
    """Return the columns `t`, `q_<name>`, `qd_<name>`, `tau_<name>`; none of a field that no message fills."""
    times: list[int] = []
    rows: list[list[np.ndarray]] = []
    other_names: dict[str, None] = {}
    for stamp, state in _messages(path, topic):
        missing = [name for name in names if name not in state.name]
        if len(missing) == len(names):
            other_names |= dict.fromkeys(state.name)
            continue
        if missing:
            raise LogError(
                f"a message with the joints {', '.join(state.name)}", file=path,
                element=f"message {len(rows) + 1}", expected=f"{', '.join(missing)} in it too",
            )  # fmt: skip
        order = [state.name.index(name) for name in names]
        times.append(stamp)
        rows.append([_field(state, field, order, path, len(rows) + 1) for field in FIELDS.values()])
    if not rows:
        raise LogError(
            f"joint states of {', '.join(other_names) or 'no joint'} only", file=path,
            expected=", ".join(names), do="map the joints' names under 'logs'",
        )  # fmt: skip
    values = np.array(rows)  # (T, 3, n)
    stamps = np.array(times)
    columns = {"t": (stamps - stamps[0]) * 1e-9}
    for index, quantity in enumerate(FIELDS):
        if not np.isnan(values[:, index]).all():
            for joint, name in enumerate(names):
                columns[PLAIN[quantity].replace("{joint}", name)] = values[:, index, joint]
    return pa.table(columns)


def _field(state: JointState, field: str, order: Sequence[int], path: Path, number: int) -> np.ndarray:
    """Return a field's values (n,) in the order of the joints; NaN where the message leaves it empty."""
    values = np.asarray(getattr(state, field), dtype=float)
    if not values.size:
        return np.full(len(order), np.nan)
    if len(values) != len(state.name):
        raise LogError(
            f"{len(values)} values for {len(state.name)} joints", file=path,
            element=f"message {number}, {field}", expected="one of each",
        )  # fmt: skip
    return values[list(order)]


def _messages(path: Path, topic: str | None) -> Iterator[tuple[int, JointState]]:
    """Yield times [ns] and joint states of one topic.

    Messages are decoded by the published definition of the standard type alone: definitions that come with a
    bag are not looked at.
    """
    try:
        from rosbags.rosbag2 import Reader
        from rosbags.typesys import Stores, get_typestore
    except ModuleNotFoundError as error:
        raise LogError(
            "a ROS 2 bag",
            file=path,
            expected="the package rosbags to read it",
            do="pip install 'spelgen[ros]'",
        ) from error
    size = path.stat().st_size
    for file in path.rglob("*"):
        if not file.is_dir():
            # rosbags opens whatever the folder holds
            require_regular_file(file, LogError, "files in the folder of a ROS 2 bag")
            size += file.stat().st_size
    store = get_typestore(Stores.ROS2_HUMBLE)
    with ExitStack() as stack:
        try:
            # rosbags unpacks a chunk whole, however large it gets; messages as arrays take ten times their bytes
            stack.enter_context(limited_memory(MEMORY + 20 * size))
            reader = stack.enter_context(Reader(path))
            by_header = None
            for _, recorded, raw in reader.messages(_connections(reader, topic, path)):
                state: JointState = store.deserialize_cdr(raw, MESSAGE)  # type: ignore[assignment]
                clock = state.header.stamp  # type: ignore[attr-defined]
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
        raise LogError(
            f"only the topics {', '.join(present) or '(none)'}", file=path, expected=f"one of {MESSAGE}"
        )
    if topic is None and len(topics) > 1:
        raise LogError(
            f"joint states on the topics {', '.join(topics)}", file=path, expected="one of them",
            do="name it by 'topic' under 'logs'",
        )  # fmt: skip
    if topic is not None and topic not in topics:
        raise LogError(f"no joint states on {topic}", file=path, expected=f"one of {', '.join(topics)}")
    return [x for x in connections if topic in (None, x.topic)]


BAG = LogFormat(read_bag, suffixes=SUFFIXES, is_folder=is_bag, folder="a ROS 2 bag")
