"""Uncommon but valid logs are read: unfinished bags, ROS 1 bags, rows of several sources, coarse clocks, LeRobot."""

import bz2
import json
import re
import struct

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet
import pytest
import torch
import yaml

from spelgen.arm.configured_arm import load_arm
from spelgen.errors import LogError, RunError, SpelgenError
from spelgen.excitation.design import excite
from spelgen.fitting.run_folder import _require_finite
from spelgen.log_checks.check_logs import check_logs
from spelgen.logs.bags import mcap_messages
from spelgen.logs.checks import check
from spelgen.logs.read import read_logs
from spelgen.logs.suggest import suggest_mapping
from spelgen.logs.trajectory import Trajectory
from spelgen.settings.log_mapping import LogMapping

STATE = "sensor_msgs/msg/JointState"
JOINTS = ("shoulder", "elbow")
T = 0.01 * np.arange(400)
Q = np.stack([np.sin(T), 0.5 * np.cos(2 * T)], axis=1)
QD = np.stack([np.cos(T), -np.sin(2 * T)], axis=1)
TAU = np.stack([5 * np.sin(T), np.cos(T)], axis=1)
START = 1_700_000_000_000_000_000


def joint_state(store, stamp: int, names, *arrays):
    """Return a JointState message of ROS 1 or ROS 2 with the time `stamp` [ns] in its header.

    store: type store of rosbags, which has the message classes. arrays: position, velocity and effort of the joints in
    `names`, (n,) each.
    """
    header, clock = store.types["std_msgs/msg/Header"], store.types["builtin_interfaces/msg/Time"]
    stamps = {"stamp": clock(sec=stamp // 10**9, nanosec=stamp % 10**9), "frame_id": ""}
    if "seq" in header.__dataclass_fields__:  # headers of ROS 1 have a sequence number
        stamps["seq"] = 0
    values = [np.array(x, dtype=float) for x in arrays]
    return store.types[STATE](header(**stamps), list(names), *values)


def bag_of(messages, folder, ros: int = 2):
    """Write a bag of JointState messages (stamp [ns], names, position, velocity, effort), received 10 ms apart."""
    pytest.importorskip("rosbags", reason="reading bags needs the extra 'ros'")
    from rosbags.rosbag1 import Writer as Ros1Writer
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as Ros2Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if ros == 1 else Stores.ROS2_HUMBLE)
    writer = (
        Ros1Writer(folder) if ros == 1 else Ros2Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP)
    )
    with writer:
        connection = writer.add_connection("/joint_states", STATE, typestore=store)
        for k, message in enumerate(messages):
            encode = store.serialize_ros1 if ros == 1 else store.serialize_cdr
            writer.write(
                connection, START + 10_000_000 * k + 777, encode(joint_state(store, *message), STATE)
            )
    return folder


def states(stamped=True):
    return [
        (START + 10_000_000 * k if stamped else 0, JOINTS[::-1], q[::-1], qd[::-1], tau[::-1])
        for k, (q, qd, tau) in enumerate(zip(Q, QD, TAU, strict=True))
    ]


def check_read(log, rows=slice(None)):
    np.testing.assert_allclose(log.q, Q[rows], rtol=1e-12)
    np.testing.assert_allclose(log.tau, TAU[rows], rtol=1e-12)
    np.testing.assert_allclose(log.t - log.t[0], T[rows] - T[rows][0], atol=1e-9)


def test_a_bag_of_ros_1_is_read(tmp_path):
    (log,) = read_logs(bag_of(states(), tmp_path / "run.bag", ros=1), JOINTS)
    check_read(log)


@pytest.mark.parametrize("share", [0.3, 0.6, 0.95])
def test_all_complete_messages_of_an_unfinished_recording_are_read(tmp_path, share):
    folder = bag_of(states(), tmp_path / "rec")
    (file,) = folder.glob("*.mcap")
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(file.read_bytes()[: int(share * file.stat().st_size)])
    (log,) = read_logs(cut, JOINTS)
    assert 0.25 * share * len(T) < len(log) <= len(T)
    check_read(log, slice(len(log)))
    assert log.remarks == ("the recording was not closed: all complete messages were read",)
    (folder / "metadata.yaml").unlink()
    (whole,) = read_logs(folder, JOINTS)
    assert len(whole) == len(T)


@pytest.mark.parametrize("encoding", ["cdr", "json", "protobuf"])
def test_mcap_files_without_the_profile_of_ros_are_read_if_their_messages_are_cdr(tmp_path, encoding):
    """Messages in CDR, the encoding of ROS, are read without a profile; other encodings are refused with a remedy.

    Tools that join or cut MCAP files omit the profile.
    """
    (path,) = bag_of(states(), tmp_path / "bag").glob("*.mcap")
    content = path.read_bytes()
    assert content[8 + 9 :].startswith(struct.pack("<I", 4) + b"ros2")
    length = struct.unpack_from("<Q", content, 9)[0]
    header = struct.pack("<BQ", 1, length - 4) + struct.pack("<I", 0) + content[8 + 9 + 8 : 8 + 9 + length]
    changed = content[:8] + header + content[8 + 9 + length :]
    size, name = struct.pack("<I", len(encoding)), encoding.encode()
    end = changed.index(b"cdr", changed.index(b"/joint_states")) - 4
    start = changed.rindex(b"\x04", 0, changed.index(b"/joint_states"))
    record = changed[start : end + 7]
    longer = (
        struct.pack("<BQ", 4, struct.unpack_from("<Q", record, 1)[0] + len(encoding) - 3)
        + record[9:-7]
        + size
        + name
    )
    (tmp_path / "x.mcap").write_bytes(changed[:start] + longer + changed[end + 7 :])
    if encoding == "cdr":
        check_read(read_logs(tmp_path / "x.mcap", JOINTS)[0])
    else:
        with pytest.raises(LogError, match=rf"joint states encoded as {encoding}, .*export them to CSV"):
            read_logs(tmp_path / "x.mcap", JOINTS)


@pytest.mark.parametrize("packed", ["lz4", "zstd"])
def test_packed_chunks_of_an_unfinished_recording_are_read(tmp_path, packed):
    """Compressed chunks of a file without index, as of a recording that was cut off, are read.

    The file is written by the format's specification, record by record.
    """
    lz4, zstd = pytest.importorskip("lz4.frame"), pytest.importorskip("backports.zstd")

    def record(code, body):
        return struct.pack("<BQ", code, len(body)) + body

    def text(value):
        return struct.pack("<I", len(value)) + value.encode()

    schema = record(3, struct.pack("<H", 1) + text(STATE) + text("ros2msg") + text(""))
    channel = record(4, struct.pack("<HH", 7, 1) + text("/joint_states") + text("cdr") + struct.pack("<I", 0))
    messages = [
        record(5, struct.pack("<HIQQ", 7, k, 1000 + k, 0) + b"content" + bytes([k])) for k in range(5)
    ]
    inside = b"".join([schema, channel, *messages])
    small = (lz4 if packed == "lz4" else zstd).compress(inside)
    head = struct.pack("<QQQI", 0, 0, len(inside), 0) + text(packed) + struct.pack("<Q", len(small))
    path = tmp_path / "x.mcap"
    whole = b"\x89MCAP0\r\n" + record(1, text("ros2") + text("")) + record(6, head + small)
    path.write_bytes(whole + record(6, head + small)[:30])
    found = list(mcap_messages(path, STATE))
    assert found == [("/joint_states", 1000 + k, b"content" + bytes([k])) for k in range(5)]
    assert list(mcap_messages(path, "other/msg/Type")) == []


def test_messages_of_a_second_publisher_are_left_out_with_one_note(tmp_path):
    messages = states()
    zeros = [(x[0], JOINTS, [0.0, 0.0], [], []) for x in messages[::5]]
    mixed = sorted([*messages, *zeros], key=lambda x: x[0])
    (log,) = read_logs(bag_of(mixed, tmp_path / "bag"), JOINTS)
    check_read(log)
    assert log.repairs == (
        f"{len(zeros)} rows left out, of another topic or publisher: without values, "
        "with positions only, or with zeros",
    )


def test_messages_without_stamps_are_left_out_or_all_have_the_time_of_the_recorder(tmp_path):
    messages = states()
    some = [(0 if k in (0, 1, 2, 200) else x[0], *x[1:]) for k, x in enumerate(messages)]
    (log,) = read_logs(bag_of(some, tmp_path / "some"), JOINTS)
    rows = [k for k in range(len(T)) if k not in (0, 1, 2, 200)]
    check_read(log, rows)
    assert log.remarks == ("4 messages without a stamp left out",)
    (log,) = read_logs(bag_of(states(stamped=False), tmp_path / "none"), JOINTS)
    check_read(log)
    assert log.remarks == ("no message has a stamp: times are those at which the recorder received them",)


@pytest.mark.parametrize("form", ["csv", "parquet"])
def test_rows_of_another_topic_are_left_out_and_a_cell_without_a_number_is_an_error(tmp_path, form):
    columns = {"t": T} | {
        f"{name}_{joint}": values[:, k]
        for name, values in (("q", Q), ("qd", QD), ("tau", TAU))
        for k, joint in enumerate(JOINTS)
    }
    rows = np.sort(np.r_[np.arange(len(T)), np.arange(0, len(T), 2)])
    other = np.r_[False, np.diff(rows) == 0]
    mixed = {name: pa.array(x[rows], mask=None if name == "t" else other) for name, x in columns.items()}
    mixed["t"] = pa.array(T[rows] + 0.003 * other)

    def write(table, path):
        (pa.csv.write_csv if form == "csv" else pa.parquet.write_table)(pa.table(table), path)
        return path

    (log,) = read_logs(write(mixed, tmp_path / f"log.{form}"), JOINTS)
    check_read(log)
    assert log.repairs[0].startswith(f"{other.sum()} rows left out, of another topic or publisher")
    mixed["tau_elbow"] = pa.array(columns["tau_elbow"][rows], mask=other | (np.arange(len(rows)) == 6))
    with pytest.raises(LogError, match="row 7, column tau_elbow: got no finite number"):
        read_logs(write(mixed, tmp_path / f"log.{form}"), JOINTS)


@pytest.mark.parametrize("suffix", [".zstd", ".zst", ".gz"])
def test_a_packed_file_is_refused_with_the_command_that_unpacks_it(tmp_path, suffix):
    (tmp_path / f"x.mcap{suffix}").write_bytes(bz2.compress(b"x"))
    for path in (tmp_path, tmp_path / f"x.mcap{suffix}"):
        with pytest.raises(LogError, match=f"convert it: (zstd -d|gunzip) .*/x.mcap{suffix}"):
            read_logs(path, JOINTS)


def columns_of(t):
    names = (("q", Q), ("qd", QD), ("tau", TAU))
    table = {f"{name}_{joint}": values[:, k] for name, values in names for k, joint in enumerate(JOINTS)}
    return pa.table({"t": t} | table)


@pytest.mark.parametrize("ticks", [2, 3.3, 10])
def test_times_of_a_coarse_clock_are_reconstructed_where_rows_are_evenly_spaced(tmp_path, ticks):
    tick = 0.01 * ticks
    path = tmp_path / "log.csv"
    pa.csv.write_csv(columns_of(1203 + np.floor(T / tick) * tick), path)
    (log,) = read_logs(path, JOINTS)
    assert len(log) == len(T)
    assert log.sample_rate == pytest.approx(100, rel=0.01)
    assert np.abs(log.t - log.t[0] - T).max() < tick
    assert "too coarse for the rows: times were reconstructed" in log.repairs[0]
    # with a `sample_rate` in the mapping, times are computed from it
    (log,) = read_logs(path, JOINTS, {"sample_rate": 100})
    check_read(log)


def test_times_of_a_coarse_clock_are_an_error_where_rows_are_not_evenly_spaced(tmp_path):
    uneven = np.cumsum(np.where(np.sin(5 * T) > 0, 0.002, 0.02))
    pa.csv.write_csv(columns_of(np.floor(uneven / 0.02) * 0.02), tmp_path / "log.csv")
    refused = pytest.raises(LogError, match=r"with the time of another row, but another state.*sample_rate")
    with refused:
        read_logs(tmp_path / "log.csv", JOINTS)
    # ten rows per step of the clock of 10 us would mean a sample rate of 1 MHz: not corrected but refused
    pa.csv.write_csv(columns_of(np.arange(400) // 10 * 1e-5), tmp_path / "log.csv")
    with refused:
        read_logs(tmp_path / "log.csv", JOINTS)


@pytest.mark.parametrize(("unit", "size"), [("ms", 1e3), ("us", 1e6), ("ns", 1e9)])
def test_times_in_another_unit_are_named_with_the_line_to_write(tmp_path, unit, size):
    path = tmp_path / "log.csv"
    pa.csv.write_csv(columns_of(np.round((1.7e9 + T) * size).astype(np.int64)), path)
    (log,) = read_logs(path, JOINTS)
    with pytest.raises(SpelgenError) as caught:
        check([log], JOINTS, ["revolute"] * 2)
    assert f"write 'units: {{t: {unit}}}' under 'logs'" in str(caught.value)
    assert f"100 Hz if times are in {unit}" in str(caught.value)
    (log,) = read_logs(path, JOINTS, {"units": {"t": unit}})
    assert check([log], JOINTS, ["revolute"] * 2) == []
    assert f'"t": "{unit}"' in suggest_mapping(path, JOINTS).text


def dataset(folder, values, fps=30, names=JOINTS, others=None):
    """Write a LeRobot 3 data set with equal positions and commands `values` (T, n) of motors with these names.

    others: {name of another feature: values (T, n)}. A name without a point gets the suffix ".pos".
    """
    (folder / "meta").mkdir(parents=True)
    (folder / "data" / "chunk-000").mkdir(parents=True)
    others = others or {}
    motors = [name if "." in name else f"{name}.pos" for name in names]
    features = {x: {"dtype": "float32", "names": motors} for x in ("observation.state", "action", *others)}
    (folder / "meta" / "info.json").write_text(json.dumps({"fps": fps, "features": features}))
    lists = pa.array(values.tolist(), pa.list_(pa.float32(), values.shape[1]))
    times = pa.array(np.arange(len(values)) / fps, pa.float32())
    table = {
        "observation.state": lists,
        "action": lists,
        "timestamp": times,
        "episode_index": np.zeros(len(values)),
        **{x: pa.array(y.tolist(), pa.list_(pa.float32(), y.shape[1])) for x, y in others.items()},
    }
    pa.parquet.write_table(pa.table(table), folder / "data" / "chunk-000" / "file-000.parquet")
    return folder


POSITION = LogMapping(input="position").model_dump(exclude_defaults=True)
CALIBRATION = {
    "shoulder": {"id": 1, "drive_mode": 0, "homing_offset": -12, "range_min": 800, "range_max": 3300},
    "elbow": {"id": 2, "drive_mode": 1, "homing_offset": 5, "range_min": 1000, "range_max": 3000},
}


def test_normalised_positions_of_lerobot_are_converted_by_the_calibration_or_refused(tmp_path):
    counts = 2048 + Q * 4096 / (2 * np.pi)
    low, high = (np.array([CALIBRATION[x][key] for x in JOINTS]) for key in ("range_min", "range_max"))
    normalised = ((counts - low) / (high - low) * 200 - 100) * [1, -1]
    folder = dataset(tmp_path / "set", normalised)
    with pytest.raises(LogError, match=r"within LeRobot's normalised range.*units: \{q: deg\}.*calibration"):
        read_logs(folder, JOINTS, POSITION)
    # LeRobot's normalised zero is the middle of the calibrated range
    expected = Q + (2048 - (low + high) / 2) * 2 * np.pi / 4096
    stated = POSITION | {"units": {"q": "normalised"}, "calibration": CALIBRATION}
    (log,) = read_logs(folder, JOINTS, stated)
    np.testing.assert_allclose(log.q, expected, atol=1e-5)
    np.testing.assert_allclose(log.u, expected, atol=1e-5)
    (folder / "calibration.json").write_text(json.dumps(CALIBRATION))
    (log,) = read_logs(folder, JOINTS, POSITION)
    np.testing.assert_allclose(log.q, expected, atol=1e-5)
    assert "normalised positions were converted by the ranges of the motors' calibration" in log.remarks
    (folder / "calibration.json").write_text(json.dumps({"shoulder": CALIBRATION["shoulder"]}))
    with pytest.raises(LogError, match="normalised range"):
        read_logs(folder, JOINTS, POSITION)


def test_motors_of_an_arm_of_a_humanoid_are_found_among_those_of_both_arms(tmp_path):
    """Motors have capital letters in place of underscores. Recorders of Unitree write them as a list of lists."""
    names = [f"kLeft{x}" for x in ("Shoulder", "Elbow")] + [f"kRight{x}" for x in ("Shoulder", "Elbow")]
    folder = dataset(tmp_path / "set", np.hstack([Q, Q + 1.0]), names=names)
    info = json.loads((folder / "meta" / "info.json").read_text())
    for feature in info["features"].values():
        feature["names"] = [feature["names"]]
    (folder / "meta" / "info.json").write_text(json.dumps(info))
    for side, offset in (("left", 0.0), ("right", 1.0)):
        joints = [f"{side}_shoulder_joint", f"{side}_elbow_joint"]
        found = suggest_mapping(folder, joints)
        assert f'"{side}_elbow_joint": {{name: "k{side.title()}Elbow"}}' in found.text and not found.missing
        (log,) = read_logs(folder, joints, POSITION | yaml.safe_load(found.text))
        np.testing.assert_allclose(log.q, Q + offset, atol=1e-5)


@pytest.mark.parametrize("form", ["features", "state"])
def test_velocities_and_torques_of_a_lerobot_data_set_are_read(tmp_path, form):
    if form == "features":
        others = {"observation.velocity": QD, "observation.effort": TAU}
        folder = dataset(tmp_path / "set", Q, fps=100, others=others)
    else:
        names = [f"{name}.{x}" for x in ("pos", "vel", "torque") for name in JOINTS]
        folder = dataset(tmp_path / "set", np.hstack([Q, QD, TAU]), fps=100, names=names)
    (log,) = read_logs(folder, JOINTS)
    for found, expected in ((log.q, Q), (log.qd, QD), (log.tau, TAU)):
        np.testing.assert_allclose(found, expected, atol=1e-6)


def test_times_of_lerobot_are_reported_as_frame_numbers_until_a_rate_is_stated(tmp_path):
    folder = dataset(tmp_path / "set", np.degrees(Q) * 3, fps=30)
    degrees = POSITION | {"units": {"q": "deg"}}
    (log,) = read_logs(folder, JOINTS, degrees)
    assert log.sample_rate == pytest.approx(30, rel=1e-3)
    assert any("times are frame numbers at 30 frames per second and not measured" in x for x in log.remarks)
    with pytest.raises(LogError, match="write 'input: position' into the YAML"):
        read_logs(folder, JOINTS, {"units": {"q": "deg"}})
    (log,) = read_logs(folder, JOINTS, degrees | {"sample_rate": 60})
    assert log.sample_rate == pytest.approx(60, rel=1e-6)
    assert log.remarks == ()


def test_a_mapping_for_a_data_set_names_its_motors(tmp_path):
    found = suggest_mapping(dataset(tmp_path / "set", np.degrees(Q)), ["Shoulder", "elbow", "gripper"])
    assert '"elbow": {name: "elbow"}' in found.text
    assert '"Shoulder": {name: "shoulder"}' in found.text
    assert found.missing == ("q of gripper",)


NO_LIMITS = {
    "0": 'effort="0" velocity="0" lower="0" upper="0"',
    "absent": "",
    "inf": 'effort="inf" velocity="INF" lower="-inf" upper="+inf"',
    "below 0": 'effort="-1" velocity="-1" lower="-1e16" upper="1e16"',
    "nan": 'effort="nan" velocity="NaN" lower="nan" upper="nan"',
    "1e16": 'effort="1e16" velocity="1e9" lower="-1e16" upper="1e16"',
    "largest": 'effort="1.7976931348623157e+308" velocity="1.7976931348623157e+308" '
    'lower="-1.7976931348623157e+308" upper="1.7976931348623157e+308"',
}


def unlimited_arm(robots, folder, name, form):
    """Return one of the project's robots without limits of position, velocity and effort.

    form: key of `NO_LIMITS`, which are attributes of a <limit> that mean "unlimited".
    """
    text = re.sub(r"<limit [^>]*/>", f"<limit {NO_LIMITS[form]}/>", (robots / f"{name}.urdf").read_text())
    (folder / "x.urdf").write_text(text)
    return load_arm(folder / "x.urdf")


@pytest.mark.parametrize("form", NO_LIMITS)
@pytest.mark.parametrize("name", ["two_link", "scara", "six_dof"])
def test_all_forms_of_no_limit_mean_unlimited_and_are_stated_once(robots, tmp_path, name, form):
    arm = unlimited_arm(robots, tmp_path, name, form)
    for joint in arm.chain.coordinates:
        assert (joint.limits, joint.effort, joint.velocity) == (None, None, None)
    (note,) = [x for x in arm.robot.diagnostics if x.code == "unlimited"]
    assert "velocity of all joints; effort of all joints" in note.message


@pytest.mark.parametrize(
    ("name", "form"), [*(("two_link", form) for form in NO_LIMITS), ("scara", "largest"), ("six_dof", "0")]
)
def test_motions_and_logs_of_unlimited_joints_have_no_limits(robots, tmp_path, name, form):
    arm = unlimited_arm(robots, tmp_path, name, form)
    ranges = {joint.name: [-0.4, 0.5] for joint in arm.chain.coordinates}
    with pytest.raises(
        SpelgenError, match="got no position limits, expected a range to move in; write 'simulation"
    ):
        excite(arm, duration=5, trials=1)
    (tmp_path / "x.yaml").write_text(json.dumps({"simulation": {"positions": ranges}}))
    motion = excite(load_arm(tmp_path / "x.urdf"), duration=5, trials=1).motion
    assert -0.4 < motion.q.min() < motion.q.max() < 0.5
    random = np.random.default_rng(0)
    t = np.arange(500) / 100
    w = random.uniform(1, 2, len(ranges))
    log = Trajectory(
        t, 0.4 * np.sin(t[:, None] * w), 0.4 * w * np.cos(t[:, None] * w), np.sin(t[:, None] * w) * 5
    )
    assert not any("limit" in x.message for x in check_logs([log], arm).findings)


def test_a_mapping_file_drops_nothing_that_the_settings_state(robots, tmp_path):
    (tmp_path / "x.urdf").write_text((robots / "two_link.urdf").read_text())
    (tmp_path / "x.yaml").write_text(
        "input: position\nlogs: {units: {q: deg}, joints: {joint1: {name: pan}, joint2: {name: lift, sign: -1}}}\n"
    )
    (tmp_path / "m.yaml").write_text(
        "columns: {q: 'pos_{joint}', u: 'goal_{joint}'}\njoints: {joint2: {offset: 0.5}}\n"
    )
    table = {"t": T} | {
        f"{name}_{motor}": np.degrees(Q[:, k])
        for k, motor in enumerate(("pan", "lift"))
        for name in ("pos", "goal")
    }
    pa.csv.write_csv(pa.table(table), tmp_path / "log.csv")
    (log,) = read_logs(tmp_path / "log.csv", load_arm(tmp_path / "x.urdf"), tmp_path / "m.yaml")
    np.testing.assert_allclose(log.q, Q * [1, -1] + [0, 0.5], atol=1e-9)
    np.testing.assert_allclose(log.u, log.q)


def test_weights_of_servos_without_effort_limits_are_accepted(tmp_path):
    _require_finite({"servo.limit": torch.tensor([float("inf"), 5.0])}, tmp_path)
    for name, value in (("servo.limit", float("nan")), ("servo.log_kp", float("inf"))):
        with pytest.raises(RunError, match="no finite numbers"):
            _require_finite({name: torch.tensor([value])}, tmp_path)


def test_times_of_lerobot_that_contradict_the_frame_rate_are_an_error(tmp_path):
    folder = dataset(tmp_path / "set", np.degrees(Q) * 3, fps=30)
    info = json.loads((folder / "meta" / "info.json").read_text())
    (folder / "meta" / "info.json").write_text(json.dumps(info | {"fps": 60}))
    degrees = POSITION | {"units": {"q": "deg"}}
    with pytest.raises(LogError, match=r"30 times per second for 60 frames per second.*'sample_rate: 60'"):
        read_logs(folder, JOINTS, degrees)
    (log,) = read_logs(folder, JOINTS, degrees | {"sample_rate": 60})
    assert log.sample_rate == pytest.approx(60, rel=1e-6)


def test_a_bag_without_names_of_joints_is_called_so(tmp_path):
    messages = [(x[0], (), *x[2:]) for x in states()]
    with pytest.raises(LogError, match="400 joint states, none with names of joints"):
        read_logs(bag_of(messages, tmp_path / "bag"), JOINTS)


def test_texts_of_times_may_have_a_zone_and_infinite_values_are_dropped_on_request(tmp_path):
    table = {
        f"{x}_{joint}": y[:, k]
        for x, y in (("q", Q), ("qd", QD), ("tau", TAU))
        for k, joint in enumerate(JOINTS)
    }
    for zone in ("Z", "+02:00", " UTC"):
        texts = [f"2026-01-01T10:00:{x:09.6f}{zone}" for x in T]
        pa.parquet.write_table(pa.table({"t": texts, **table}), tmp_path / "log.parquet")
        (log,) = read_logs(tmp_path / "log.parquet", JOINTS)
        np.testing.assert_allclose(log.t, T, atol=1e-6)
    broken = TAU[:, 0].copy()
    broken[100] = np.inf
    pa.parquet.write_table(pa.table({"t": T, **table, "tau_shoulder": broken}), tmp_path / "log.parquet")
    (log,) = read_logs(tmp_path / "log.parquet", JOINTS, {"dropouts": "dropped"})
    assert len(log) == len(T) - 1


def columns(**changed):
    return {"t": T} | {
        f"{x}_{joint}": y[:, k]
        for x, y in ({"q": Q, "qd": QD, "tau": TAU} | changed).items()
        for k, joint in enumerate(JOINTS)
    }


def test_messages_of_a_publisher_of_zeros_are_left_out_with_one_note(tmp_path):
    """Messages of a second publisher, whose velocities and efforts are all 0, are omitted, with one remark."""
    messages = states()
    zeros = [(x[0] + 3_000_000, JOINTS, [0.1, 0.1], [0.0, 0.0], [0.0, 0.0]) for x in messages]
    for count in (1, 5):
        mixed = sorted([*messages, *zeros[::count]], key=lambda x: x[0])
        (log,) = read_logs(bag_of(mixed, tmp_path / f"bag{count}"), JOINTS)
        check_read(log)
        assert log.repairs[0].startswith(
            f"{len(zeros[::count])} rows left out, of another topic or publisher"
        )
    # velocities and efforts of 0 at the start, of an arm at rest with motors off, are not omitted
    rest = [(x[0], JOINTS, x[2], [0.0, 0.0], [0.0, 0.0]) if k < 50 else x for k, x in enumerate(messages)]
    assert len(read_logs(bag_of(rest, tmp_path / "rest"), JOINTS)[0]) == len(T)


@pytest.mark.parametrize("fault", ["16 bits", "minutes", "set back", "dates"])
def test_a_clock_that_goes_back_while_the_motion_continues_is_joined(tmp_path, fault):
    t = {
        "16 bits": (1000 * T + 65000) % 65536,
        "minutes": 1000 * ((T + 57) % 60),
        "set back": 1000 * (T - 0.7 * (T > 1.995)),
        "dates": 1000 * (1.7e9 + T - 0.7 * (T > 1.995)),
    }[fault]
    pa.parquet.write_table(pa.table(columns() | {"t": t}), tmp_path / "x.parquet")
    (log,) = read_logs(tmp_path / "x.parquet", JOINTS, {"units": {"t": "ms"}})
    np.testing.assert_allclose(log.t - log.t[0], T, atol=1e-5)
    np.testing.assert_array_equal(log.q, Q)
    assert log.repairs == ("the clock went back 1 time while the motion continued: times were joined",)
    other = np.where(np.arange(len(T))[:, None] > np.argmin(np.diff(t)), Q + 1, Q)
    pa.parquet.write_table(pa.table(columns(q=other) | {"t": t}), tmp_path / "x.parquet")
    if fault in ("set back", "dates"):
        with pytest.raises(LogError, match="number the recordings"):
            read_logs(tmp_path / "x.parquet", JOINTS, {"units": {"t": "ms"}})


@pytest.mark.parametrize("unit", [60.0, 3600.0, 86400.0])
def test_times_in_minutes_hours_or_days_are_not_units_of_positions(tmp_path, unit):
    """For times in minutes, hours or days, the error advises the right `sample_rate`, and no unit of the positions."""
    pa.parquet.write_table(pa.table(columns() | {"t": T / unit}), tmp_path / "x.parquet")
    log = read_logs(tmp_path / "x.parquet", JOINTS)
    with pytest.raises(LogError, match="write 'sample_rate: 100'") as caught:
        check(log, JOINTS, ["revolute"] * 2)
    assert "units:" not in str(caught.value) and "counts" not in str(caught.value)
    check(read_logs(tmp_path / "x.parquet", JOINTS, {"sample_rate": 100}), JOINTS, ["revolute"] * 2)
    if unit > 60:
        log = read_logs(tmp_path / "x.parquet", JOINTS, {"velocity": "differentiated"})
        with pytest.raises(LogError, match="faster than any arm is sampled: write 'sample_rate'"):
            check(log, JOINTS, ["revolute"] * 2)


def test_episodes_without_a_file_are_counted(tmp_path):
    folder = dataset(tmp_path / "set", np.degrees(Q) * 3)
    info = json.loads((folder / "meta" / "info.json").read_text())
    for total, remarks in ((1, ()), (3, ("2 episodes of 3 without a file: 1, 2",))):
        (folder / "meta" / "info.json").write_text(json.dumps(info | {"total_episodes": total}))
        (log,) = read_logs(folder, JOINTS, POSITION | {"units": {"q": "deg"}})
        assert tuple(x for x in log.remarks if "episode" in x) == remarks


def test_an_older_calibration_of_lerobot_is_one_error_and_other_motors_do_not_matter(tmp_path):
    folder = dataset(tmp_path / "set", np.degrees(Q))
    old = {
        "homing_offset": [2048, 0],
        "drive_mode": [0, 1],
        "calib_mode": ["DEGREE"] * 2,
        "motor_names": list(JOINTS),
    }
    (folder / "calibration.json").write_text(json.dumps(old))
    for mapping in (POSITION, POSITION | {"units": {"q": "normalised"}, "calibration": old}):
        with pytest.raises(SpelgenError, match="data of an older LeRobot is in degrees") as caught:
            read_logs(folder, JOINTS, mapping)
        assert str(caught.value).count("\n") == 0
    gripper = {"gripper": {"id": 6, "drive_mode": 0, "homing_offset": 0, "range_min": 5, "range_max": 5}}
    (folder / "calibration.json").write_text(json.dumps(CALIBRATION | gripper))
    assert len(read_logs(folder, JOINTS, POSITION)) == 1


def test_the_range_of_other_elements_of_a_state_does_not_matter(tmp_path):
    """Positions in rad are not mistaken for normalised values if the gripper in the same state has values to 100."""
    folder = dataset(tmp_path / "set", np.column_stack([Q, 50 + 50 * np.sin(T)]), names=(*JOINTS, "gripper"))
    (log,) = read_logs(folder, JOINTS, POSITION)
    np.testing.assert_allclose(log.q, Q, atol=1e-6)


def test_prefixed_motors_of_a_data_set_get_the_line_that_names_them(tmp_path):
    folder = dataset(tmp_path / "set", np.degrees(Q) * 3, names=("left_shoulder", "left_elbow"))
    with pytest.raises(LogError, match=r"write 'joints: \{shoulder: \{name: left_shoulder\}, elbow: "):
        read_logs(folder, JOINTS, POSITION)
    wrong = POSITION | {"joints": {"shoulder": {"name": "shoulder"}, "elbow": {"name": "elbow"}}}
    renamed = {"joints": {"j1": {"name": "shoulder"}, "j2": {"name": "elbow"}}}
    with pytest.raises(LogError, match=r"write 'joints: \{shoulder: \{name: left_shoulder\}, elbow: "):
        read_logs(folder, JOINTS, wrong)
    for logs in (
        folder,
        bag_of([(x[0], ("left_elbow", "left_shoulder"), *x[2:]) for x in states()], tmp_path / "bag"),
    ):
        with pytest.raises(LogError, match=r"write 'joints: \{j1: \{name: left_shoulder\}, j2: "):
            read_logs(logs, ("j1", "j2"), (POSITION if logs is folder else {}) | renamed)
    partial = bag_of([(x[0], ("elbow",), *(y[:1] for y in x[2:])) for x in states()], tmp_path / "partial")
    with pytest.raises(LogError, match=r"without shoulder, .*'moving_joints: \[j2\]'"):
        read_logs(partial, ("j1", "j2"), renamed)
    with pytest.raises(LogError, match="write them as 'names' of the features"):
        read_logs(dataset(tmp_path / "other", Q, names=()), JOINTS, POSITION)
