"""ROS 2 bags (MCAP, sqlite3) -> a table of joint states, by the package `rosbags`: no ROS is needed."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from spelgen.errors import LogError
from spelgen.settings.log_mapping import PLAIN

SUFFIXES = (".mcap", ".db3")
MESSAGE = "sensor_msgs/msg/JointState"
FIELDS = {"q": "position", "qd": "velocity", "tau": "effort"}


def is_bag(path: Path) -> bool:
    """Whether this is a bag's folder, or a file of its storage alone."""
    return (path / "metadata.yaml").is_file() if path.is_dir() else path.suffix in SUFFIXES


def read_bag(path: Path, names: Sequence[str], topic: str | None) -> pa.Table:
    """The joint states of a bag as columns `t`, `q_<name>`, `qd_<name>`, `tau_<name>` of the wanted names.

    t [s] counts from the first message: by the header's stamps, or by the recorder's clock where the first
    stamp is 0. A message with none of the names is another device's and passed over. A field that no message
    fills has no column. Raises LogError, also where `rosbags` is not installed.
    """
    times: list[int] = []
    rows: list[list[np.ndarray]] = []
    seen: dict[str, None] = {}
    for stamp, state in _messages(path, topic):
        seen |= dict.fromkeys(state.name)
        there = [name for name in names if name in state.name]
        if not there:
            continue
        if len(there) < len(names):
            missing = ", ".join(name for name in names if name not in there)
            raise LogError(
                f"a message with the joints {', '.join(state.name)}", file=path,
                element=f"message {len(rows) + 1}", expected=f"{missing} in it too",
            )  # fmt: skip
        order = [state.name.index(name) for name in names]
        times.append(stamp)
        rows.append([_field(state, field, order, path, len(rows)) for field in FIELDS.values()])
    if not rows:
        raise LogError(
            f"joint states of {', '.join(seen) or 'no joint'} only", file=path,
            expected=", ".join(names), do="map the joints' names under 'logs'",
        )  # fmt: skip
    return _table(np.array(times), np.array(rows), names)


def _table(times: np.ndarray, values: np.ndarray, names: Sequence[str]) -> pa.Table:
    """times: (T,) [ns]. values: (T, 3, n)."""
    columns = {"t": (times - times[0]) * 1e-9}
    for index, quantity in enumerate(FIELDS):
        if not np.isnan(values[:, index]).all():
            found = {PLAIN[quantity].replace("{joint}", name): k for k, name in enumerate(names)}
            columns |= {column: values[:, index, k] for column, k in found.items()}
    return pa.table(columns)


def _field(state: Any, field: str, order: Sequence[int], path: Path, index: int) -> np.ndarray:
    """(n,) in the wanted order; NaN where the message leaves the field empty."""
    values = np.asarray(getattr(state, field), dtype=float)
    if not values.size:
        return np.full(len(order), np.nan)
    if len(values) != len(state.name):
        raise LogError(
            f"{len(values)} values for {len(state.name)} joints", file=path,
            element=f"message {index + 1}, {field}", expected="one of each",
        )  # fmt: skip
    return values[list(order)]


def _messages(path: Path, topic: str | None) -> Iterator[tuple[int, Any]]:
    """Times [ns] and joint states of one topic.

    Only the standard message type is ever decoded, by its published definition: definitions that come with a
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
    endless = next((each for each in path.rglob("*") if not (each.is_file() or each.is_dir())), None)
    if endless is not None:
        raise LogError("a pipe or a device", file=endless, expected="files in the folder of a ROS 2 bag")
    store = get_typestore(Stores.ROS2_HUMBLE)
    with ExitStack() as stack:
        try:
            reader = stack.enter_context(Reader(path))
            connections = _connections(reader, topic, path)
            stamped = None
            for _, recorded, raw in reader.messages(connections):
                state = store.deserialize_cdr(raw, MESSAGE)
                clock = state.header.stamp  # type: ignore[attr-defined]
                stamp = clock.sec * 1_000_000_000 + clock.nanosec
                stamped = bool(stamp) if stamped is None else stamped
                yield stamp if stamped else recorded, state
        except (LogError, GeneratorExit):
            raise
        except Exception as error:  # rosbags, its storages and their decompressors raise many kinds
            reason = " ".join(f"{type(error).__name__}: {error}".split()).rstrip(".")
            raise LogError(f"an unreadable ROS 2 bag ({reason})", file=path) from error


def _connections(reader: Any, topic: str | None, path: Path) -> list[Any]:
    found = [each for each in reader.connections if each.msgtype == MESSAGE]
    topics = sorted({each.topic for each in found})
    if not topics:
        there = ", ".join(sorted({f"{each.topic} ({each.msgtype})" for each in reader.connections}))
        raise LogError(f"only the topics {there or '(none)'}", file=path, expected=f"one of {MESSAGE}")
    if topic is None and len(topics) > 1:
        raise LogError(
            f"joint states on the topics {', '.join(topics)}", file=path, expected="one of them",
            do="name it by 'topic' under 'logs'",
        )  # fmt: skip
    if topic is not None and topic not in topics:
        raise LogError(f"no joint states on {topic}", file=path, expected=f"one of {', '.join(topics)}")
    return [each for each in found if topic in (None, each.topic)]
