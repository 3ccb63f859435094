"""Read bags of ROS 2 (MCAP, sqlite3) and ROS 1 by the package `rosbags`: no ROS is needed."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa

from spelgen.errors import LogError, in_one_line
from spelgen.files import limited_memory, require_regular_file
from spelgen.labels import counted
from spelgen.logs.mcap import MAGIC, mcap_messages
from spelgen.logs.tables import LogFormat, LogTable, table_layout
from spelgen.settings.log_mapping import PLAIN, LogColumns, LogMapping

ROS1 = ".bag"
MESSAGE = "sensor_msgs/msg/JointState"
MEMORY = 2**29  # bytes in addition to the messages of a bag
FIELDS = {"q": "position", "qd": "velocity", "tau": "effort"}


class StampedState(NamedTuple):
    """A joint state with the times [ns] of its header, 0 if it has none, and of the recorder."""

    stamp: int
    recorded: int
    state: Any


def read_bag(path: Path, joints: Sequence[str], mapping: LogMapping) -> list[LogTable]:
    """Return the joint states of a bag, or of a file of its storage, as one table.

    t [s] counts from the first message: by the header's stamps, or by the recorder's clock if no message has a stamp.
    Messages without any of the joints belong to another device and are omitted. Raises LogError, also if `rosbags` is
    not installed.
    """
    remarks: list[str] = []
    messages = _stamped(list(_messages(path, mapping.topic, remarks)), remarks)
    table = _joint_states(path, messages, list(map(mapping.log_name, joints)))
    # fields of messages are in SI units by definition: columns and units of the mapping do not apply
    mapping = mapping.with_joint_columns(dict.fromkeys(joints, dict.fromkeys(FIELDS)))
    mapping = mapping.model_copy(update={"columns": LogColumns()})
    layout = table_layout(table.schema, joints, mapping, path)
    return [(replace(layout, remarks=tuple(remarks)), table)]


def _stamped(messages: Sequence[StampedState], remarks: list[str]) -> list[tuple[int, Any]]:
    """Return times [ns] of one clock, and the states; the clocks of header and recorder may differ by hours."""
    without = sum(not message.stamp for message in messages)
    if messages and without == len(messages):
        remarks.append("no message has a stamp: times are those at which the recorder received them")
        return [(message.recorded, message.state) for message in messages]
    if without:
        remarks.append(f"{counted(without, 'message')} without a stamp left out")
    return [(message.stamp, message.state) for message in messages if message.stamp]


def _joint_states(path: Path, messages: Sequence[tuple[int, Any]], names: Sequence[str]) -> pa.Table:
    """Return the columns `t`, `q_<name>`, `qd_<name>`, `tau_<name>`; fields that are always empty are omitted."""
    times: list[int] = []
    rows: list[np.ndarray] = []
    other_names: dict[str, None] = {}
    for stamp, state in messages:
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
        values = np.full((len(FIELDS), len(state.name)), np.nan)  # for empty fields of the message
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


def _messages(path: Path, topic: str | None, remarks: list[str]) -> Iterator[StampedState]:
    """Yield the joint states of one topic.

    Messages are decoded only by the published definition of the standard type; definitions in the bag are ignored.
    """
    try:
        from rosbags.rosbag1 import Reader as Ros1Reader
        from rosbags.rosbag2 import Reader as Ros2Reader
        from rosbags.typesys import Stores, get_typestore
    except ModuleNotFoundError as error:
        expected, do = "the package rosbags to read it", "pip install 'spelgen[ros]'"
        raise LogError("a ROS bag", file=path, expected=expected, do=do) from error
    size = path.stat().st_size
    for file in path.rglob("*"):
        if not file.is_dir():
            # rosbags opens all files of the folder
            require_regular_file(file, LogError, "files in the folder of a ROS 2 bag")
            size += file.stat().st_size
    is_ros1 = path.suffix == ROS1
    store = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_HUMBLE)
    decode = store.deserialize_ros1 if is_ros1 else store.deserialize_cdr
    try:
        # rosbags unpacks a whole chunk of any size; messages as arrays take ten times their bytes
        with limited_memory(MEMORY + 20 * size):
            unfinished = [] if is_ros1 else _unfinished(path)
            if unfinished:
                messages = _without_end(unfinished, topic, path, remarks)
            else:
                messages = _read_by(Ros1Reader if is_ros1 else Ros2Reader, topic, path)
            for recorded, raw in messages:
                state: Any = decode(raw, MESSAGE)
                clock = state.header.stamp
                yield StampedState(clock.sec * 1_000_000_000 + clock.nanosec, recorded, state)
    except (LogError, GeneratorExit):
        raise
    except Exception as error:  # rosbags, its storages and their decompressors raise many types
        reason = in_one_line(error).rstrip(".")
        do = "a recording that was not closed may be repaired by `ros2 bag reindex` or `rosbag reindex`"
        raise LogError(
            f"an unreadable ROS bag ({reason})", file=path, do=None if isinstance(error, MemoryError) else do
        ) from error


def _read_by(open_bag: Callable[[Path], Any], topic: str | None, path: Path) -> Iterator[tuple[int, bytes]]:
    """Yield times [ns] and contents of the joint states of one topic."""
    with open_bag(path) as reader:
        topics = {x.topic for x in reader.connections if x.msgtype == MESSAGE}
        others = {f"{x.topic} ({x.msgtype})" for x in reader.connections}
        chosen = _chosen_topic(topics, others, topic, path)
        connections = [x for x in reader.connections if x.msgtype == MESSAGE and x.topic == chosen]
        for _, recorded, raw in reader.messages(connections):
            yield recorded, raw


def _unfinished(path: Path) -> list[Path]:
    """Return the MCAP files of a bag if one of them is incomplete, else none."""
    files = sorted(path.glob("*.mcap")) if path.is_dir() else [path]
    for file in files:
        with file.open("rb") as source:
            if source.read(len(MAGIC)) == MAGIC:
                source.seek(-len(MAGIC), 2)
                if source.read() != MAGIC:
                    return files
    return []


def _without_end(
    files: Sequence[Path], topic: str | None, path: Path, remarks: list[str]
) -> Iterator[tuple[int, bytes]]:
    """Yield times [ns] and contents of the joint states of one topic, in files of which one is incomplete."""
    messages = list(chain(*(mcap_messages(file, MESSAGE) for file in files)))
    if not messages:
        raise LogError(
            "a recording that was not closed, without a complete message of joint states", file=path,
            expected="an MCAP file with an end", do="try `mcap recover FILE`",
        )  # fmt: skip
    chosen = _chosen_topic({topic for topic, _, _ in messages}, set(), topic, path)
    remarks.append("the recording was not closed: all complete messages were read")
    for name, recorded, raw in messages:
        if name == chosen:
            yield recorded, raw


def _chosen_topic(topics: set[str], present: set[str], topic: str | None, path: Path) -> str:
    """Return the requested topic of joint states, or the only one."""
    if topic in topics:
        return topic
    if topic is None and len(topics) == 1:
        return topics.pop()
    names, do = ", ".join(sorted(topics)), None
    if not topics:
        listed = ", ".join(sorted(present)) or "(none)"
        got, expected = f"only the topics {listed}", f"one of {MESSAGE}"
    elif topic is None:
        got, expected, do = (
            f"joint states on the topics {names}",
            "one of them",
            "name it by 'topic' under 'logs'",
        )
    else:
        got, expected = f"no joint states on {topic}", f"one of {names}"
    raise LogError(got, file=path, expected=expected, do=do)


BAG = LogFormat(read_bag, suffixes=(".mcap", ".db3", ROS1), marker="metadata.yaml", folder="a ROS 2 bag")
