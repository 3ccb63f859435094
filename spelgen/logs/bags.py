"""Reader of bags of ROS 2 (MCAP, sqlite3) and ROS 1 with the package `rosbags`; a ROS installation is not needed.

A recorder that was killed writes an MCAP file without the summary and index at the end, which `rosbags` cannot read.
This module reads the records of such a file itself. A record is an operation code (1 byte), a length (8 bytes) and a
body. https://mcap.dev/spec
"""

import re
import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa

from spelgen.errors import LogError, in_one_line
from spelgen.files import limited_memory, require_regular_file
from spelgen.labels import counted
from spelgen.logs.joint_signals import mapping_line
from spelgen.logs.tables import LogTable, joint_patterns
from spelgen.settings.log_mapping import PLAIN, LogColumns, LogMapping

ROS1 = ".bag"
MESSAGE = "sensor_msgs/msg/JointState"
MEMORY = 2**29  # [B] memory for reading a bag, in addition to 20 times the bag's size
FIELDS = {"q": "position", "qd": "velocity", "tau": "effort"}
MAGIC = b"\x89MCAP0\r\n"  # bytes at the beginning and at the end of a complete MCAP file
SCHEMA, CHANNEL, MESSAGE_RECORD, CHUNK = 3, 4, 5, 6  # operation codes of records in an MCAP file

RawState = tuple[str, int, bytes]
"""Topic, time [ns] of the recorder, and encoded joint state."""


class StampedState(NamedTuple):
    """Joint state of one message.

    Attributes:
        topic: topic of the message.
        stamp: time stamp [ns] in the message header; 0 if the publisher has set none.
        recorded: time [ns] at which the recorder received the message.
        state: decoded message.
    """

    topic: str
    stamp: int
    recorded: int
    state: Any


def read_bag(path: Path, joints: Sequence[str], mapping: LogMapping) -> list[LogTable]:
    """Return a list of one table: the joint states of a bag, or of a single file of a bag.

    Times t [s] are relative to the first message. They are the stamps of the headers, or the times of the recorder if
    no message has a stamp. Messages without any of the joints belong to another device and are omitted. Raises
    LogError for a bag that cannot be read, and if `rosbags` is not installed.
    """
    remarks: list[str] = []
    names = {joint: mapping.log_name(joint) for joint in joints}
    messages = _of_one_arm(list(_messages(path, mapping.topic, remarks)), names, path, remarks)
    stamped = [message for message in messages if message.stamp]
    times = np.array([message.stamp for message in stamped])
    # The clocks of publisher (stamps) and recorder may differ by hours: times are all from one of the two clocks.
    if not stamped:
        remarks.append("no message has a stamp: times are those at which the recorder received them")
        stamped, times = messages, np.array([message.recorded for message in messages])
    elif len(stamped) < len(messages):
        remarks.append(f"{counted(len(messages) - len(stamped), 'message')} without a stamp left out")
    columns = {"t": (times - times[0]) * 1e-9} | _joint_states(path, stamped, list(names.values()))
    # ROS defines the fields of a joint state in SI units, so columns and units of the mapping do not apply to bags.
    mapping = mapping.with_joint_columns(dict.fromkeys(joints, dict.fromkeys(FIELDS)))
    mapping = mapping.model_copy(update={"columns": LogColumns()})
    return [LogTable.of(pa.table(columns), mapping, remarks=tuple(remarks))]


def _of_one_arm(
    messages: Sequence[StampedState], names: Mapping[str, str], path: Path, remarks: list[str]
) -> list[StampedState]:
    """Return the messages of a bag that contain any joint of the arm.

    A message may contain only some of the joints, and joints may be on several topics. If most of the messages contain
    all joints, the others are omitted. Raises LogError if several topics contain the same joint, or if a joint is in no
    message. names: {joint: its name in the log}. remarks: list to which a remark on omitted messages is added.
    """
    arm = set(names.values())
    of_arm = [x for x in messages if not arm.isdisjoint(x.state.name)]
    if not of_arm:
        logged = list(dict.fromkeys(name for x in messages for name in x.state.name))
        if not logged:
            got = f"{counted(len(messages), 'joint state')}, none with names of joints"
            raise LogError(got, file=path, expected=f"joint states of {', '.join(names.values())}")
        got = f"joint states of {', '.join(logged)} only"
        raise LogError(got, file=path, expected=", ".join(names.values()), do=names_line(names, logged))
    joints_of: dict[str, set[str]] = {}
    for message in of_arm:
        joints_of.setdefault(message.topic, set()).update(arm.intersection(message.state.name))
    if sum(map(len, joints_of.values())) > len(set.union(*joints_of.values())):
        topics = sorted(joints_of)
        got, do = f"joint states on the topics {', '.join(topics)}", mapping_line({"topic": topics[0]})
        raise LogError(got, file=path, expected="one of them", do=f"{do}, or the other topic")
    missing = [name for name in names.values() if name not in set.union(*joints_of.values())]
    if missing:
        got, expected = f"joint states without {', '.join(missing)}", "states of all joints of the arm"
        present = ", ".join(joint for joint, name in names.items() if name not in missing)
        do = f"write 'moving_joints: [{present}]' into the robot's YAML if the others do not move, or map their names"
        raise LogError(got, file=path, expected=expected, do=do)
    complete = [x for x in of_arm if arm.issubset(x.state.name)]
    if len(complete) > len(of_arm) / 2:
        if len(complete) < len(of_arm):
            remarks.append(f"{counted(len(of_arm) - len(complete), 'message')} without all joints left out")
        return complete
    return of_arm


def _joint_states(
    path: Path, messages: Sequence[StampedState], names: Sequence[str]
) -> dict[str, np.ndarray]:
    """Return the columns `q_<name>`, `qd_<name>` and `tau_<name>` of the joints `names` from T messages, each (T,).

    Fields that are empty in all messages are omitted; values of joints that a message does not contain are NaN.
    """
    data = np.full((len(FIELDS), len(names), len(messages)), np.nan)
    for row, (*_, state) in enumerate(messages):
        logged = [k for k, name in enumerate(names) if name in state.name]
        indices = [state.name.index(names[k]) for k in logged]
        for values, field in zip(data, FIELDS.values(), strict=True):
            array = np.asarray(getattr(state, field), dtype=float)
            if len(array) not in (0, len(state.name)):
                got, element = f"{len(array)} values for {len(state.name)} joints", f"message {row + 1}"
                raise LogError(got, file=path, element=f"{element}, {field}", expected="one of each")
            # Empty fields of a joint state are skipped: ROS allows them, for example without efforts.
            if len(array):
                values[logged, row] = array[indices]
    columns: dict[str, np.ndarray] = {}
    for quantity, by_joint in zip(FIELDS, data, strict=True):
        if not np.isnan(by_joint).all():
            pattern = PLAIN[quantity]
            columns |= {pattern.replace("{joint}", x): y for x, y in zip(names, by_joint, strict=True)}
    return columns


def names_in_log(names: Mapping[str, str], logged: Sequence[str]) -> dict[str, str]:
    """Return {joint: its name in a log} for joints that are found in the names of a log (see `joint_patterns`).

    Of several names with a joint's name, the one with the fewest words is the joint's: panda_joint1 in place of
    panda_finger_joint1. names: {joint: its name in the mapping}, by default its name in the URDF.
    """
    patterns, name_of = joint_patterns(list(names.values()), logged), dict[str, str]()
    for joint, name in names.items():
        words = {x: len(re.findall(r"[^\W_]+", x)) for x in logged if patterns[name].search(x)}
        fewest = [x for x, count in words.items() if count == min(words.values())]
        name_of |= {joint: fewest[0]} if len(fewest) == 1 else {}
    return name_of


def names_line(names: Mapping[str, str], logged: Sequence[str]) -> str:
    """Return the advice, for an error message, to map the names of joints to names in the log.

    For the arguments and the search see `names_in_log`. Joints that are not found have a placeholder.
    """
    name_of = names_in_log(names, logged)
    return mapping_line({"joints": {x: {"name": name_of.get(x, "NAME IN THE LOG")} for x in names}})


def logged_names(path: Path) -> list[str]:
    """Return the names of all joints in the joint states of a bag."""
    return list(dict.fromkeys(name for message in _messages(path, None, []) for name in message.state.name))


def _messages(path: Path, topic: str | None, remarks: list[str]) -> Iterator[StampedState]:
    """Yield the decoded joint states in a bag: on `topic`, or on all topics if it is None.

    Messages are decoded with the published definition of `JointState`; message definitions in the bag are ignored.
    remarks: list to which a remark on a recorder that was killed is added.
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
            # A pipe in the folder of a bag is an error: rosbags opens all files of the folder, and reading a pipe may
            # not end.
            require_regular_file(file, LogError, "files in the folder of a ROS 2 bag")
            size += file.stat().st_size
    is_ros1 = path.suffix == ROS1
    store = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_HUMBLE)
    decode = store.deserialize_ros1 if is_ros1 else store.deserialize_cdr
    try:
        # The memory of the process is limited, since a damaged bag may contain chunks that rosbags unpacks to any size.
        # Messages decoded to arrays need ten times their size in the file, so a limit of 20 times the file size
        # suffices.
        with limited_memory(MEMORY + 20 * size):
            messages = _read_by(Ros1Reader if is_ros1 else Ros2Reader, path)
            other_files = [] if is_ros1 else _of_other_recorders(path, remarks)
            if other_files:
                messages = _joint_states_in(other_files, path)
            topics = set()
            for name, recorded, raw in messages:
                topics.add(name)
                if topic in (None, name):
                    state: Any = decode(raw, MESSAGE)
                    clock = state.header.stamp
                    yield StampedState(name, clock.sec * 1_000_000_000 + clock.nanosec, recorded, state)
        if topic is not None and topic not in topics:
            expected = f"one of {', '.join(sorted(topics))}"
            raise LogError(f"no joint states on {topic}", file=path, expected=expected)
    except (LogError, GeneratorExit):
        raise
    except Exception as error:  # rosbags raises exceptions of many types: all are caught
        do = "a recording that was not closed may be repaired by `ros2 bag reindex` or `rosbag reindex`"
        got = f"an unreadable ROS bag ({in_one_line(error).rstrip('.')})"
        raise LogError(got, file=path, do=None if isinstance(error, MemoryError) else do) from error


def _read_by(open_bag: Callable[[Path], Any], path: Path) -> Iterator[RawState]:
    """Yield the encoded joint states on all topics of a bag.

    open_bag: function that opens the bag, a reader class of `rosbags`. Raises LogError if the bag has no joint states.
    """
    with open_bag(path) as reader:
        connections = [x for x in reader.connections if x.msgtype == MESSAGE]
        if not connections:
            topics = sorted({f"{x.topic} ({x.msgtype})" for x in reader.connections})
            got = f"only the topics {', '.join(topics) or '(none)'}"
            raise LogError(got, file=path, expected=f"one of {MESSAGE}")
        for connection, recorded, raw in reader.messages(connections):
            yield connection.topic, recorded, raw


def _of_other_recorders(path: Path, remarks: list[str]) -> list[Path]:
    """Return all MCAP files of a bag that `rosbags` cannot open; [] if it can open the bag.

    `rosbags` cannot open a bag if one of its files was not closed (the end of the file is missing), or does not state
    the profile "ros2" in its header. `_joint_states_in` reads such files. remarks: list to which a remark is added if
    a file was not closed.
    """
    files = sorted(path.glob("*.mcap")) if path.is_dir() else [path]
    is_closed = is_ros2 = True
    for file in files:
        with file.open("rb") as source:
            head = source.read(64)
            if head.startswith(MAGIC):
                # The first record of an MCAP file begins, after its code and length, with the profile, such as "ros2".
                # Tools that join or cut files write an empty profile, and `rosbags` then refuses the file.
                is_ros2 &= _text(head, len(MAGIC) + 9) == "ros2"
                source.seek(-len(MAGIC), 2)
                is_closed &= source.read() == MAGIC
    if not is_closed:
        remarks.append("the recording was not closed: all complete messages were read")
    return [] if is_closed and is_ros2 else files


def _joint_states_in(files: Sequence[Path], path: Path) -> Iterator[RawState]:
    """Yield the encoded joint states on all topics of MCAP files, which may lack their end.

    path: path of the bag, for errors. Raises LogError if there are no joint states.
    """
    messages = list(chain(*(mcap_messages(file, MESSAGE) for file in files)))
    if not messages:
        got = "no complete message of joint states"
        do = "if the recording was not closed, try `mcap recover FILE`"
        raise LogError(got, file=path, expected=f"messages of {MESSAGE}", do=do)
    yield from messages


def mcap_messages(path: Path, message_type: str) -> Iterator[RawState]:
    """Yield topic, recorder's time [ns] and encoded content of each complete message of a type in an MCAP file.

    Raises LogError for messages of this type in another encoding than CDR.
    """
    types: dict[int, str] = {}
    topics: dict[int, str] = {}
    for code, body in _records(path.read_bytes()[len(MAGIC) :]):
        if code == SCHEMA:
            types[struct.unpack_from("<H", body)[0]] = _text(body, 2)
        elif code == CHANNEL:
            number, schema = struct.unpack_from("<HH", body)
            if types.get(schema) == message_type:
                topics[number] = _text(body, 4)
                encoding = _text(body, 8 + len(topics[number].encode()))
                if encoding != "cdr":
                    got = f"joint states encoded as {encoding}"
                    do = "export them to CSV, or record by `ros2 bag record`"
                    raise LogError(got, file=path, expected="messages of ROS 2 (cdr)", do=do)
        elif code == MESSAGE_RECORD:
            number, _, recorded = struct.unpack_from("<HIQ", body)
            if number in topics:
                yield topics[number], recorded, body[22:]


def _records(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield operation code and body of each complete record in the bytes of an MCAP file; chunks are unpacked."""
    start = 0
    while start + 9 <= len(data):
        code, length = struct.unpack_from("<BQ", data, start)
        body = data[start + 9 : start + 9 + length]
        start += 9 + length
        # The last chunk of an interrupted recording is read, too: it is incomplete, but begins with complete records.
        if code == CHUNK:
            yield from _records(_unpacked(body))
        elif len(body) == length:
            yield code, body


def _unpacked(chunk: bytes) -> bytes:
    """Return the decompressed bytes of a chunk of an MCAP file: a sequence of records.

    If the chunk is incomplete, the part that can be decompressed is returned.
    """
    if len(chunk) < 40:
        return b""
    (size,) = struct.unpack_from("<Q", chunk, 16)
    compression = _text(chunk, 28)
    packed = chunk[32 + len(compression) + 8 :]
    if not compression:
        return packed
    if compression == "zstd":
        from backports.zstd import ZstdDecompressor

        return ZstdDecompressor().decompress(packed, size)
    from lz4.frame import LZ4FrameDecompressor  # type: ignore[import-untyped]

    return bytes(LZ4FrameDecompressor().decompress(packed, size))


def _text(data: bytes, start: int) -> str:
    """Return the text at the offset `start` of a record; MCAP stores a text as its length (4 bytes) and characters."""
    (length,) = struct.unpack_from("<I", data, start)
    return data[start + 4 : start + 4 + length].decode()
