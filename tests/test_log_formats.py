"""Each log format and each naming of columns gives the same trajectories, or one clear error."""

import csv
import datetime as dt
import json
import os
import re
import subprocess
import sys
import textwrap
import tracemalloc
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet
import pytest
import yaml

from spelgen.arm.configured_arm import load_arm
from spelgen.errors import LogError, SettingsError, SpelgenErrors
from spelgen.logs import checks, formats, npz
from spelgen.logs.bags import names_in_log
from spelgen.logs.formats import FORMATS
from spelgen.logs.read import read_logs, write_logs
from spelgen.logs.suggest import suggest_mapping
from spelgen.logs.tables import LogFormat, LogTable
from spelgen.logs.trajectory import Trajectory
from spelgen.settings.log_mapping import LogMapping

JOINTS = ("shoulder", "elbow")
T = np.array([0.0, 0.01, 0.02, 0.03])
Q = np.array([[0.1, -0.2], [0.11, -0.21], [0.13, -0.23], [0.16, -0.26]])
QD = np.array([[1.0, -1.0], [1.5, -1.5], [2.5, -2.5], [3.0, -3.0]])
TAU = np.array([[5.0, 6.0], [5.5, 6.5], [6.0, 7.0], [6.5, 7.5]])


def check(found: Trajectory, name: str, *, q=Q, qd=QD, tau=TAU, rtol=0.0):
    assert found.name == name
    for values, expected in ((found.t, T), (found.q, q), (found.qd, qd), (found.tau, tau)):
        np.testing.assert_allclose(values, expected, rtol=rtol, atol=1e-9 if rtol else 0.0)


def parquet(path: Path, columns: dict) -> Path:
    pa.parquet.write_table(pa.table(columns), path)
    return path


def columns(**changed) -> dict:
    found = {"t": T}
    for quantity, values in {"q": Q, "qd": QD, "tau": TAU}.items():
        found |= {f"{quantity}_{joint}": values[:, k] for k, joint in enumerate(JOINTS)}
    return found | changed


# ---- mappings


def test_units_signs_offsets_and_gains_are_applied(tmp_path):
    log = {
        "time us": (T * 1e6).astype(np.int64),
        "s pos": np.rad2deg(Q[:, 0] - 0.5),
        "s vel": np.rad2deg(QD[:, 0]),
        "s cur": TAU[:, 0] * 1000 / 12.5,
        "J2.counts": -Q[:, 1] / (2 * np.pi) * 4096,
        "e vel": -QD[:, 1] * 60 / (2 * np.pi),
        "e cur": (TAU[:, 1] - 0.25) / 2.0 * 1000,
    }
    text = {
        "columns": {"t": "time us", "q": "{joint} pos", "qd": "{joint} vel", "tau": "{joint} cur"},
        "units": {"t": "us", "q": "deg", "qd": "deg/s", "tau": "mA"},
        "joints": {
            "shoulder": {"name": "s", "offset": 0.5, "gain": 12.5},
            "elbow": {
                "name": "e",
                "columns": {"q": "J2.counts"},
                "units": {"q": "counts", "qd": "rpm"},
                "counts_per_turn": 4096,
                "sign": -1,
                "gain": -2.0,
                "torque_offset": 0.25,
            },
        },
    }
    path = parquet(tmp_path / "robot.parquet", log)
    (found,) = read_logs([path], JOINTS, mapping=LogMapping.model_validate(text))
    check(found, "robot", rtol=1e-12)


def test_prismatic_counts_are_metres(tmp_path):
    log = {"t": T, "q_slide": Q[:, 0] * 5000, "qd_slide": QD[:, 0] * 1000, "tau_slide": TAU[:, 0]}
    mapping = {"units": {"q": "counts", "qd": "mm/s"}, "joints": {"slide": {"counts_per_metre": 5000}}}
    (found,) = read_logs(
        [parquet(tmp_path / "x.parquet", log)],
        ("slide",),
        mapping=LogMapping.model_validate(mapping),
        joint_types=("prismatic",),
    )
    check(found, "x", q=Q[:, :1], qd=QD[:, :1], tau=TAU[:, :1], rtol=1e-12)


def test_velocities_are_differentiated_only_where_that_is_asked(tmp_path):
    # the times have gaps after 0.5 s and before the last sample
    t = np.concatenate([np.arange(50) * 0.01, 5 + np.arange(50) * 0.01, [20.0]])
    log = {"t": t, "q_a": np.sin(t), "tau_a": t}
    path = parquet(tmp_path / "x.parquet", log)
    with pytest.raises(LogError, match=r"missing column qd_a: got only the columns t, q_a, tau_a"):
        read_logs([path], ("a",))
    (found,) = read_logs([path], ("a",), mapping=LogMapping(velocity="differentiated"))
    inner = [k for k in range(100) if k % 50 not in (0, 49)]
    # error of central differences: dt^2 |d^3 q / dt^3| / 6 = 1.7e-5 rad/s
    np.testing.assert_allclose(found.qd[inner, 0], np.cos(t[inner]), atol=2e-5)
    # error of one-sided differences at the ends of segments: dt |qdd| / 2 = 0.005 rad/s for dt = 0.01 s, |qdd| <= 1
    assert np.abs(found.qd[[0, 49, 50, 99], 0] - np.cos(t[[0, 49, 50, 99]])).max() < 0.006
    assert found.qd[100] == 0.0


def test_logs_written_by_spelgen_are_not_mapped(tmp_path):
    write_logs(tmp_path / "x.parquet", [Trajectory(T, Q, QD, TAU, "x")], JOINTS)
    mapping = LogMapping.model_validate({"units": {"q": "deg"}, "columns": {"t": "clock"}})
    (found,) = read_logs([tmp_path / "x.parquet"], JOINTS, mapping=mapping)
    check(found, "x")


def test_timestamps_count_from_the_first(tmp_path):
    start = 1_700_000_000_000_000_000
    stamps = start + np.array([0, 10_000_000, 20_000_000, 30_000_000])
    for values, mapping in (
        (pa.array(stamps, pa.timestamp("ns")), LogMapping()),
        (pa.array(stamps), LogMapping.model_validate({"units": {"t": "ns"}})),
    ):
        path = parquet(tmp_path / "x.parquet", columns(t=values))
        check(read_logs([path], JOINTS, mapping=mapping)[0], "x", rtol=1e-15)


def test_typed_times_count_from_the_first_however_small_it_is(tmp_path):
    stamps = 50_000_000 + np.array([0, 10_000_000, 20_000_000, 30_000_000])
    path = parquet(tmp_path / "x.parquet", columns(t=pa.array(stamps, pa.duration("ns"))))
    check(read_logs([path], JOINTS)[0], "x", rtol=1e-15)
    # the first time stamp is unset (zero), so that a gap follows it
    stamps = 1_700_000_000_000_000_001 + np.array([0, 10_000_000, 20_000_000, 30_000_000])
    stamps[0] = 0
    path = parquet(tmp_path / "x.parquet", columns(t=pa.array(stamps, pa.timestamp("ns"))))
    assert np.diff(read_logs([path], JOINTS)[0].t)[1:] == pytest.approx(0.01)


def test_measured_currents_times_gains_are_the_recorded_torques(shared):
    gains = {"shoulder_pan": 14.87, "shoulder_lift": 13.26, "elbow": 11.13, "wrist_1": 10.62}
    gains |= {"wrist_2": 11.03, "wrist_3": 11.47}  # [Nm/A] motor gains of the UR10e, from logs/README.md
    joints = [f"{name}_joint" for name in gains]
    text = {
        "columns": {"tau": "i_{joint}"},
        "units": {"tau": "A"},
        "joints": {joint: {"gain": gain} for joint, gain in zip(joints, gains.values(), strict=True)},
    }
    path = shared / "logs" / "ur10e" / "19_12_23_free.parquet"
    (plain,), (mapped,) = (
        read_logs([path], joints, mapping=mapping) for mapping in (None, LogMapping.model_validate(text))
    )
    np.testing.assert_allclose(mapped.tau, plain.tau, atol=1e-6)


def test_a_mapping_may_be_a_dict_a_file_or_that_of_the_arm(robots, tmp_path):
    joints = ("joint1", "joint2")
    turned = {f"{what}_{joint}": -x[:, k] for what, x in (("q", Q), ("qd", QD), ("tau", TAU))
              for k, joint in enumerate(joints)}  # fmt: skip
    path = parquet(tmp_path / "x.parquet", {"clock": T} | turned)
    text = "columns: {t: clock}\njoints:\n  joint1: {sign: -1}\n  joint2: {sign: -1}\n"
    (tmp_path / "names.yaml").write_text(text)
    (tmp_path / "arm.urdf").write_bytes((robots / "two_link.urdf").read_bytes())
    (tmp_path / "arm.yaml").write_text("logs:\n" + textwrap.indent(text, "  "))
    arm = load_arm(tmp_path / "arm.urdf")
    keys = {"columns": {"t": "clock"}, "joints": {joint: {"sign": -1} for joint in joints}}
    for given, mapping in ((joints, keys), (joints, tmp_path / "names.yaml"), (arm, None), (arm, keys)):
        check(read_logs(path, given, mapping)[0], "x")
    with pytest.raises(SettingsError) as caught:
        read_logs(path, joints, {"columns": {"time": "clock"}})
    assert (
        str(caught.value)
        == "mapping: columns: unknown key 'time'; known are 't', 'trajectory', 'q', 'qd', 'tau', 'u'"
    )


@pytest.mark.parametrize("arm", ["arm.urdf", ["a", 2], 3])
def test_an_argument_that_is_no_arm_is_refused(tmp_path, arm):
    with pytest.raises(LogError) as caught:
        read_logs(tmp_path, arm)
    assert str(caught.value) == (
        f"read_logs: got {arm!r}, expected an arm of load_arm, a model, or joint names in a list"
    )


MISFITS = {
    "current": (
        {"units": {"tau": "A"}, "joints": {"elbow": {"gain": 2.0}}},
        "logs: joint 'shoulder', tau: got the unit A, expected a gain beside it",
    ),
    "counts": (
        {"joints": {"elbow": {"units": {"q": "counts"}, "counts_per_metre": 10}}},
        "logs: joint 'elbow', q: got the unit counts, expected counts_per_turn beside it",
    ),
    "length": (
        {"joints": {"elbow": {"units": {"qd": "mm/s"}}}},
        "logs: joint 'elbow', qd: got the unit mm/s, expected one of a revolute joint",
    ),
}


@pytest.mark.parametrize("case", MISFITS)
def test_a_mapping_that_does_not_fit_is_refused(tmp_path, case):
    mapping, message = MISFITS[case]
    path = parquet(tmp_path / "x.parquet", columns())
    with pytest.raises(SettingsError) as caught:
        read_logs([path], JOINTS, mapping=LogMapping.model_validate(mapping), joint_types=("revolute",) * 2)
    assert str(caught.value) == message


def test_a_pattern_without_joint_is_refused(tmp_path):
    path = parquet(tmp_path / "x.parquet", columns())
    with pytest.raises(LogError) as caught:
        read_logs([path], JOINTS, mapping=LogMapping.model_validate({"columns": {"q": "q_elbow"}}))
    assert str(caught.value) == (
        f"{path}: column q_elbow: got one column for several joints, "
        "expected '{joint}' in its name under 'logs'"
    )


# ---- NPZ


def test_npz_columns(tmp_path):
    np.savez(tmp_path / "x.npz", **columns(trajectory=np.array(["a", "a", "b", "b"])))
    first, second = read_logs([tmp_path], JOINTS)
    assert (first.name, second.name) == ("a", "b")
    np.testing.assert_array_equal(np.concatenate([first.q, second.q]), Q)


def test_npz_matrices_by_the_arm_s_order_or_by_names(tmp_path):
    np.savez(tmp_path / "x.npz", t=T, q=Q, qd=QD, tau=TAU)
    check(read_logs([tmp_path / "x.npz"], JOINTS)[0], "x")
    turned = {"q": Q[:, ::-1], "qd": QD[:, ::-1], "tau": TAU[:, ::-1]}
    np.savez(tmp_path / "y.npz", t=T, joints=np.array(JOINTS[::-1]), **turned)
    check(read_logs([tmp_path / "y.npz"], JOINTS)[0], "y")


@pytest.mark.parametrize("axis", [0, 1])
def test_arrays_of_a_simulator_of_several_arms_with_one_arm_are_read(tmp_path, axis):
    arrays = {"q": Q, "qd": QD, "tau": TAU}
    np.savez(tmp_path / "x.npz", t=T, **{name: np.expand_dims(x, axis) for name, x in arrays.items()})
    check(read_logs([tmp_path / "x.npz"], JOINTS)[0], "x")


def test_npz_with_an_array_for_each_recording(tmp_path):
    arrays = {}
    for k in (3, 4):
        arrays |= {f"t_{k}": T[:k], f"qp_{k}": Q[:k], f"qv_{k}": QD[:k], f"tau_{k}": TAU[:k]}
    np.savez(tmp_path / "x.npz", labels=np.array(["a", "b"]), **arrays)
    names = {
        "t": "t_{trajectory}",
        "q": "qp_{trajectory}",
        "qd": "qv_{trajectory}",
        "tau": "tau_{trajectory}",
    }
    short, whole = read_logs([tmp_path], JOINTS, mapping=LogMapping.model_validate({"columns": names}))
    check(whole, "4")
    np.testing.assert_array_equal(short.q, Q[:3])


def test_delan_characters_are_read(shared):
    names = {
        "t": "t_{trajectory}",
        "q": "qp_{trajectory}",
        "qd": "qv_{trajectory}",
        "tau": "tau_{trajectory}",
    }
    mapping = LogMapping.model_validate({"columns": names})
    found = read_logs([shared / "logs" / "delan_characters"], JOINTS, mapping=mapping)
    assert len(found) == 20
    assert found[0].q.shape == (150, 2)


NPZ = {
    "missing": (
        {"t": T, "q": Q, "tau": TAU},
        "{}: missing columns qd_shoulder, qd_elbow: got only the columns t, q, tau, "
        "expected t, q_<joint>, qd_<joint>, tau_<joint>; "
        "write 'velocity: differentiated' under 'logs' in the robot's YAML where none were logged",
    ),
    "short": (
        {"t": T, "q": Q[:3], "qd": QD, "tau": TAU},
        "{}: array q: got an array of shape (3, 2), expected a value for each of the 4 times; "
        "resample it to these times",
    ),
    "wide": (
        {"t": T, "q": np.ones((4, 3)), "qd": QD, "tau": TAU},
        "{}: array q: got 3 columns, expected 2, one for each joint; name them by an array 'joints'",
    ),
    "unknown": (
        {"t": T, "q": Q, "qd": QD, "tau": TAU, "joints": np.array(["shoulder", "wrist"])},
        "{}: array joints: got the joints shoulder, wrist, "
        "expected elbow among the names of the 2 columns of q",
    ),
}


@pytest.mark.parametrize("case", NPZ)
def test_bad_npz_is_refused_in_one_sentence(tmp_path, case):
    arrays, message = NPZ[case]
    np.savez(tmp_path / "x.npz", **arrays)
    with pytest.raises(LogError) as caught:
        read_logs([tmp_path / "x.npz"], JOINTS)
    assert str(caught.value) == message.format(tmp_path / "x.npz")


def test_npz_never_unpickles(tmp_path):
    np.savez(tmp_path / "x.npz", **columns(q_elbow=np.array([print] * 4, dtype=object)))
    with pytest.raises(LogError, match=r"x\.npz: array .*: got Python objects, expected numbers; store"):
        read_logs([tmp_path], JOINTS)
    (tmp_path / "x.npz").write_bytes(b"not an archive")
    with pytest.raises(LogError, match=r"x\.npz: an unreadable npz file"):
        read_logs([tmp_path], JOINTS)


def test_arrays_that_are_no_columns_are_not_read(tmp_path):
    """Members of an archive that are no columns of the log are not read.

    One inflates to 2 GB of zeros, one is no array, one is pickled.
    """
    np.savez_compressed(tmp_path / "x.npz", **columns(pickled=np.array([print], dtype=object)))
    with zipfile.ZipFile(tmp_path / "x.npz", "a", compression=zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("README.txt", "how this was recorded")
        with archive.open("image.npy", "w", force_zip64=True) as member:
            member.write(
                b"\x93NUMPY\x01\x00v\x00{'descr': '<f8', 'fortran_order': False, 'shape': (250000000,), }"
            )
            for _ in range(64):
                member.write(bytes(2**20))
    tracemalloc.start()
    check(read_logs([tmp_path / "x.npz"], JOINTS)[0], "x")
    assert tracemalloc.get_traced_memory()[1] < 5e6
    tracemalloc.stop()


def test_arrays_that_unpack_to_more_than_memory_are_refused(tmp_path, monkeypatch):
    np.savez_compressed(tmp_path / "x.npz", **columns(q_elbow=np.zeros(2_000_000)))
    assert (tmp_path / "x.npz").stat().st_size < 50_000
    monkeypatch.setattr(npz, "TUNING", replace(npz.TUNING, npz_bytes=1_000_000))
    tracemalloc.start()
    with pytest.raises(LogError) as caught:
        read_logs(tmp_path / "x.npz", JOINTS)
    assert tracemalloc.get_traced_memory()[1] < 1e6
    tracemalloc.stop()
    assert str(caught.value) == (
        f"{tmp_path}/x.npz: array q_elbow.npy: got 0.016 GB of arrays, expected at most 0.001 GB; "
        "write larger logs as Parquet"
    )


def test_arrays_that_promise_more_than_they_hold_are_refused(tmp_path):
    head = b"\x93NUMPY\x01\x00v\x00{'descr': '<f8', 'fortran_order': False, 'shape': (100000000000000,), }"
    np.savez(tmp_path / "x.npz", **{name: array for name, array in columns().items() if name != "t"})
    with zipfile.ZipFile(tmp_path / "x.npz", "a") as archive:
        archive.writestr("t.npy", head.ljust(127) + b"\n" + bytes(80))
    with pytest.raises(LogError, match=r"x\.npz: an unreadable npz file"):
        read_logs(tmp_path / "x.npz", JOINTS)


def test_a_new_format_is_a_reader_and_its_name_among_the_formats(tmp_path, monkeypatch):
    """A new log format needs only a reader and an entry in FORMATS, as docs/extending.md states.

    Files of the format are then found in folders, read, named in messages, and get a suggested mapping.
    """

    def read(file, joints, mapping):
        rows = [[float(x) for x in line.split()] for line in file.read_text().splitlines()]
        return [LogTable.of(pa.table(dict(zip(columns(), np.transpose(rows), strict=True))), mapping)]

    monkeypatch.setattr(formats, "FORMATS", [*FORMATS, LogFormat(read, suffixes=(".txt",))])
    np.savetxt(tmp_path / "x.txt", np.stack(list(columns().values()), axis=1), fmt="%.17g")
    check(read_logs(tmp_path, JOINTS)[0], "x")
    assert "q_shoulder" in suggest_mapping(tmp_path / "x.txt", JOINTS).text
    with pytest.raises(LogError, match=r"got a file of kind '\.odd', expected .*\.bag, \.txt, the folder"):
        (tmp_path / "y.odd").touch()
        read_logs(tmp_path / "y.odd", JOINTS)


def test_a_trajectory_named_twice_in_a_column_is_one_text(tmp_path):
    arrays = {f"{k}/t_{k}": T for k in ("a", "b")} | {"a/t_b": T, "/t_": T}
    for k in ("a", "b"):
        arrays |= {f"{k}/q_{k}": Q, f"{k}/qd_{k}": QD, f"{k}/tau_{k}": TAU}
    np.savez(tmp_path / "x.npz", **arrays)
    names = {quantity: f"{{trajectory}}/{quantity}_{{trajectory}}" for quantity in ("t", "q", "qd", "tau")}
    found = read_logs(tmp_path / "x.npz", JOINTS, {"columns": names})
    assert [x.name for x in found] == ["a", "b"]


@pytest.mark.parametrize("form", ["demo_{}/{}", "data/demo_{}/obs/{}", "{}_{}", "{1}_{0}"])
@pytest.mark.parametrize("timed", [True, False])
def test_numbered_demonstrations_of_an_archive_are_drafted_as_recordings(tmp_path, form, timed):
    """Arrays that differ in one number, as of HDF5 groups, are recordings; `sample_rate` replaces absent times."""
    arrays = {}
    for k in range(3):
        quantities = {"q": Q + k, "qd": QD, "tau": TAU} | ({"t": T} if timed else {})
        arrays |= {form.format(k, name): values for name, values in quantities.items()}
    np.savez(tmp_path / "x.npz", **arrays, filters=["all", "none"])
    text = suggest_mapping(tmp_path / "x.npz", JOINTS).text
    found = read_logs(
        tmp_path / "x.npz", JOINTS, yaml.safe_load(text.replace("sample_rate:", "sample_rate: 100"))
    )
    assert [x.name for x in found] == ["0", "1", "2"]
    for k, log in enumerate(found):
        np.testing.assert_allclose(log.q, Q + k)
        np.testing.assert_allclose(log.t, T)


def test_numbered_arrays_with_shared_times_are_of_several_arms(tmp_path):
    """Arrays that have the times of a common array are simultaneous signals, and no recordings one after another."""
    arrays = {f"{name}_{k}": x + k for name, x in (("q", Q), ("qd", QD), ("tau", TAU)) for k in range(2)}
    np.savez(tmp_path / "x.npz", t=T, **arrays)
    with pytest.raises(LogError, match="positions of 2 arms"):
        suggest_mapping(tmp_path / "x.npz", JOINTS)


def test_repeated_patterns_do_not_backtrack(tmp_path):
    """A column pattern with six placeholders is matched quickly against a name of 5000 letters.

    A regular expression would backtrack for centuries.
    """
    np.savez(tmp_path / "x.npz", **{"a" * 5000: T})
    with pytest.raises(LogError, match="missing column"):
        read_logs(tmp_path / "x.npz", JOINTS, {"columns": {"t": "{trajectory}" * 6 + "t"}})


@pytest.mark.parametrize("suffix", [".csv", ".parquet", ".npz", ".mcap"])
def test_pipes_among_logs_are_not_waited_for(tmp_path, suffix):
    os.mkfifo(tmp_path / f"live{suffix}")
    with pytest.raises(LogError) as caught:
        read_logs(tmp_path / f"live{suffix}", JOINTS)
    kinds = ".parquet, .csv, .tsv, .npz, .jsonl, .ndjson, .json, .mcap, .db3, .bag"
    kinds += ", the folder of a ROS 2 bag or of a LeRobot data set"
    assert str(caught.value) == f"{tmp_path}/live{suffix}: got no regular file, expected a file: {kinds}"
    parquet(tmp_path / "x.parquet", columns())
    check(read_logs(tmp_path, JOINTS)[0], "x")


# ---- ROS 2 bags

STATE = "sensor_msgs/msg/JointState"


@pytest.fixture(params=["MCAP", "SQLITE3"])
def bag(request, tmp_path):
    """Return a function that writes a bag of (topic, names, position, velocity, effort) messages, 10 ms apart."""
    pytest.importorskip("rosbags", reason="reading ROS 2 bags needs the extra 'ros'")
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    state, header, stamp = (
        store.types[name] for name in (STATE, "std_msgs/msg/Header", "builtin_interfaces/msg/Time")
    )

    def write(messages, stamped=True, kind=STATE):
        folder = tmp_path / "bag"
        with Writer(folder, version=9, storage_plugin=StoragePlugin[request.param]) as writer:
            connections = {
                topic: writer.add_connection(topic, kind, typestore=store)
                for topic in dict.fromkeys(message[0] for message in messages)
            }
            for k, (topic, names, *values) in enumerate(messages):
                time = 1_700_000_000_000_000_000 + 10_000_000 * k
                clock = stamp(sec=time // 10**9 * stamped, nanosec=time % 10**9 * stamped)
                arrays = [np.array(x, dtype=float, order="C") for x in values]
                message = state(header(stamp=clock, frame_id=""), list(names), *arrays)
                writer.write(connections[topic], time + 777_777, store.serialize_cdr(message, STATE))
        return folder

    return write


STATES = [("/joint_states", JOINTS[::-1], *(x[::-1] for x in each)) for each in zip(Q, QD, TAU, strict=True)]


@pytest.mark.parametrize("stamped", [True, False])
def test_bags_are_read(bag, stamped):
    folder = bag(STATES, stamped)
    (found,) = read_logs([folder], JOINTS)
    check(found, "bag", rtol=1e-12)
    (storage,) = [path for path in folder.iterdir() if path.suffix in (".mcap", ".db3")]
    (alone,) = read_logs([storage], JOINTS)
    np.testing.assert_array_equal(alone.q, found.q)
    (in_folder,) = read_logs([folder.parent], JOINTS)
    assert in_folder.name == "bag"


def test_another_device_on_the_topic_is_passed_over(bag):
    gripper = ("/joint_states", ["finger"], [0.0], [0.0], [0.0])
    (found,) = read_logs([bag([STATES[0], gripper, *STATES[1:]])], JOINTS)
    np.testing.assert_array_equal(found.q, Q)


def test_names_of_a_bag_are_mapped(bag):
    states = [(topic, ["s", "e"], *values) for topic, _, *values in STATES]
    folder = bag(states)
    mapping = {"joints": {"shoulder": {"name": "e"}, "elbow": {"name": "s"}}}
    check(read_logs([folder], JOINTS, mapping=LogMapping.model_validate(mapping))[0], "bag", rtol=1e-12)
    with pytest.raises(
        LogError, match=r"joint states of s, e only, expected shoulder, elbow; write 'joints: "
    ):
        read_logs([folder], JOINTS)


@pytest.mark.parametrize("prefix", ["", "fer_"])
def test_the_line_that_maps_prefixed_names_of_a_bag_is_right(bag, prefix):
    joints = [prefix + name for name in JOINTS]
    folder = bag([(topic, [f"left_{name}" for name in names], *values) for topic, names, *values in STATES])
    with pytest.raises(LogError) as caught:
        read_logs([folder], joints)
    (line,) = re.findall(r"write '(.*)' under 'logs'", str(caught.value))
    mapping = LogMapping.model_validate(yaml.safe_load(f"{{{line}}}"))
    check(read_logs([folder], joints, mapping=mapping)[0], "bag", rtol=1e-12)
    drafted = LogMapping.model_validate(yaml.safe_load(suggest_mapping(folder, joints).text))
    check(read_logs([folder], joints, mapping=drafted)[0], "bag", rtol=1e-12)


def test_names_of_fingers_are_no_names_of_the_arm_and_two_arms_are_ambiguous():
    joints = {f"fer_joint{k}": f"fer_joint{k}" for k in (1, 2)}
    fingers = [f"panda_{x}joint{k}" for x in ("finger_", "") for k in (1, 2)]
    assert names_in_log(joints, fingers) == {x: x.replace("fer", "panda") for x in joints}
    assert not names_in_log(joints, [f"{side}_joint{k}" for side in ("left", "right") for k in (1, 2)])


def test_of_several_topics_one_is_named(bag):
    folder = bag([*STATES, ("/other", JOINTS, [0, 0], [0, 0], [0, 0])])
    with pytest.raises(LogError) as caught:
        read_logs([folder], JOINTS)
    assert str(caught.value) == (
        f"{folder}: got joint states on the topics /joint_states, /other, expected one of them; "
        "write 'topic: /joint_states' under 'logs' in the robot's YAML, or the other topic"
    )
    check(read_logs([folder], JOINTS, mapping=LogMapping(topic="/joint_states"))[0], "bag", rtol=1e-12)
    with pytest.raises(
        LogError, match=r"got no joint states on /left, expected one of /joint_states, /other"
    ):
        read_logs([folder], JOINTS, mapping=LogMapping(topic="/left"))


def test_empty_fields_of_a_bag_are_missing_columns(bag):
    folder = bag([(topic, names, q, [], []) for topic, names, q, _, _ in STATES])
    text = r"missing columns qd_shoulder, qd_elbow, tau_shoulder, tau_elbow.*; log them, torques for example as efforts"
    with pytest.raises(LogError, match=text):
        read_logs([folder], JOINTS)


def test_a_pipe_in_a_bag_is_not_waited_for(bag):
    folder = bag(STATES)
    os.mkfifo(folder / "live")
    with pytest.raises(LogError) as caught:
        read_logs([folder], JOINTS)
    assert str(caught.value) == (
        f"{folder}/live: got no regular file, expected files in the folder of a ROS 2 bag"
    )


BAD_BAGS = {
    "part": (
        [("/a", JOINTS[:1], [0.0], [0.0], [0.0])],
        "{}: got joint states without elbow, expected states of all joints of the arm; write "
        "'moving_joints: [shoulder]' into the robot's YAML if the others do not move, or map their names",
    ),
    "lengths": (
        [STATES[0], ("/joint_states", JOINTS, [0.0], [0.0, 0.0], [0.0, 0.0])],
        "{}: message 2, position: got 1 values for 2 joints, expected one of each",
    ),
}


@pytest.mark.parametrize("case", BAD_BAGS)
def test_bad_bags_are_refused_in_one_sentence(bag, case):
    messages, message = BAD_BAGS[case]
    folder = bag(messages)
    with pytest.raises(LogError) as caught:
        read_logs([folder], JOINTS)
    assert str(caught.value) == message.format(folder)


def test_a_bag_without_joint_states_is_refused(bag):
    folder = bag(STATES, kind="std_msgs/msg/String")
    with pytest.raises(LogError) as caught:
        read_logs([folder], JOINTS)
    assert str(caught.value) == (
        f"{folder}: got only the topics /joint_states (std_msgs/msg/String), expected one of {STATE}"
    )


def test_a_broken_bag_is_refused(tmp_path):
    pytest.importorskip("rosbags", reason="reading ROS 2 bags needs the extra 'ros'")
    for name in ("x.mcap", "y.db3"):
        (tmp_path / name).write_bytes(b"not a bag")
    with pytest.raises(SpelgenErrors) as caught:
        read_logs([tmp_path], JOINTS)
    first, second = str(caught.value).splitlines()
    assert first.startswith(f"{tmp_path}/x.mcap: an unreadable ROS bag (")
    assert second.startswith(f"{tmp_path}/y.db3: an unreadable ROS bag (")


def test_without_rosbags_the_extra_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rosbags.rosbag2", None)
    (tmp_path / "x.mcap").write_bytes(b"")
    with pytest.raises(LogError) as caught:
        read_logs([tmp_path], JOINTS)
    assert str(caught.value) == (
        f"{tmp_path}/x.mcap: got a ROS bag, expected the package rosbags to read it; "
        "pip install 'spelgen[ros]'"
    )


# ---- anomalous files: read, or refused with file, row and column


def text_log(separator: str = ",", decimal: str = ".", names: str = "{}") -> str:
    rows = [[t, *q, *qd, *tau] for t, q, qd, tau in zip(T, Q, QD, TAU, strict=True)]
    head = ["t", *(f"{x}_{joint}" for x in ("q", "qd", "tau") for joint in JOINTS)]
    lines = [separator.join(map(names.format, head))]
    return (
        "\n".join(lines + [separator.join(str(x).replace(".", decimal) for x in row) for row in rows]) + "\n"
    )


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "latin-1"])
@pytest.mark.parametrize(("separator", "decimal"), [(",", "."), (";", ","), ("|", "."), ("\t", ",")])
def test_csv_as_spreadsheets_write_it(tmp_path, separator, decimal, encoding):
    joints = tuple(f"{joint}°" for joint in JOINTS)
    (tmp_path / "x.csv").write_bytes(text_log(separator, decimal, "{}").encode(encoding))
    check(read_logs(tmp_path / "x.csv", JOINTS)[0], "x")
    named = text_log(separator, decimal).replace("shoulder", "shoulder°").replace("elbow", "elbow°")
    (tmp_path / "x.csv").write_bytes(named.encode(encoding))
    check(read_logs(tmp_path / "x.csv", joints)[0], "x")


@pytest.mark.parametrize("encoding", ["utf-16-le", "utf-16-be"])
def test_the_byte_order_of_a_csv_needs_no_mark(tmp_path, encoding):
    (tmp_path / "x.csv").write_bytes(text_log().encode(encoding))
    check(read_logs(tmp_path / "x.csv", JOINTS)[0], "x")


UNIT_LINE = "s,rad,rad,rad/s,rad/s,Nm,Nm"


def delimited(lines: list[str], delimiter: str) -> list[str]:
    return [line.replace(",", delimiter) for line in lines]


FORMS = {
    "Excel's delimiter": lambda lines: ["sep=;", *delimited(lines, ";")],
    "quoted decimal commas and semicolons": lambda lines: [
        ";".join(f'"{x}"'.replace(".", ",") for x in line.split(",")) for line in lines
    ],
    "lines of a recorder": lambda lines: ["Recorder 3.2", "robot: arm, 6 axes", "", *lines],
    "MATLAB's comments": lambda lines: ["% arm 3", *lines],
    "a header in a comment": lambda lines: ["# arm, 3", f"# {lines[0]}", *lines[1:]],
    "a header in a comment, spaces": lambda lines: [
        f"# {lines[0].replace(',', ' ')}",
        *delimited(lines[1:], " "),
    ],
    "aligned by spaces": lambda lines: [
        " " + "  ".join(x.rjust(12) for x in line.split(",")) for line in lines
    ],
    "rows that end with a comma": lambda lines: [lines[0], *(f"{line}," for line in lines[1:])],
    "quantities above joints": lambda lines: [",q,q,qd,qd,tau,tau", f"t{',shoulder,elbow' * 3}", *lines[1:]],
    "merged quantities above joints": lambda lines: [
        ",q,,qd,,tau,",
        f"{',shoulder,elbow' * 3}",
        "t,,,,,,",
        *lines[1:],
    ],
    "comments": lambda lines: ["# arm 3", "# 26 November", *lines],
    "notes between rows": lambda lines: [*lines[:2], "# speed 50 %", *lines[2:], "# end"],
    "units with digits": lambda lines: [
        f"{lines[0]},acc",
        f"{UNIT_LINE},m/s2",
        *(f"{x},0" for x in lines[1:]),
    ],
    "a line of units": lambda lines: [lines[0], UNIT_LINE, *lines[1:]],
    "units above the header": lambda lines: [UNIT_LINE, *lines],
    "units in a comment": lambda lines: ["# arm 3", f"# {UNIT_LINE}", *lines],
    "descriptions below units": lambda lines: [
        lines[0],
        UNIT_LINE,
        *[",".join(["measured"] * 7)],
        *lines[1:],
    ],
    "the header twice": lambda lines: [lines[0], *lines],
    "comments and units": lambda lines: ["# arm 3", lines[0], UNIT_LINE, *lines[1:]],
    "decimal commas in quotes": lambda lines: [
        lines[0],
        *(",".join(f'"{x}"'.replace(".", ",") for x in line.split(",")) for line in lines[1:]),
    ],
}


@pytest.mark.parametrize("form", FORMS)
def test_lines_of_a_csv_that_are_no_rows(tmp_path, form):
    (tmp_path / "x.csv").write_text("\n".join(FORMS[form](text_log().splitlines())) + "\n")
    check(read_logs(tmp_path / "x.csv", JOINTS)[0], "x")


@pytest.mark.parametrize("form", ["comments and units", "the header twice"])
def test_a_wrong_cell_after_lines_of_units_is_reported_with_its_line(tmp_path, form):
    lines = FORMS[form](text_log().replace("-0.23", "o.23").splitlines())
    (tmp_path / "x.csv").write_text("\n".join(lines))
    number = 1 + next(k for k, line in enumerate(lines) if "o.23" in line)
    with pytest.raises(LogError, match=rf"x\.csv:{number}: row 3, column q_elbow: got 'o\.23'"):
        read_logs(tmp_path / "x.csv", JOINTS)


def test_the_cut_last_line_of_a_csv_is_left_out(tmp_path):
    """The incomplete last line of a CSV, as of a recorder that lost power, is omitted with a remark.

    An incomplete line elsewhere is an error with its number.
    """
    lines = text_log().splitlines()
    (tmp_path / "x.csv").write_text("\n".join([*lines, lines[-1][:9]]))
    (found,) = read_logs(tmp_path / "x.csv", JOINTS)
    check(found, "x")
    assert found.remarks == (f"the last line is no complete row and was left out: {lines[-1][:9]}",)
    (tmp_path / "x.csv").write_text("\n".join([*lines[:3], lines[3][:9], *lines[4:]]))
    with pytest.raises(LogError, match=r"x\.csv:4: got \d values \(.*\), expected 7, as in the header"):
        read_logs(tmp_path / "x.csv", JOINTS)


@pytest.mark.parametrize(
    "footer",
    [
        "\nSamples: 4\nDuration: 3 s\n",
        "\nMin,-1,-2,-3,-4,-5,-6\n\nMean,0.1,0.2,0.3,0.4,0.5,0.6\n",
        '\n"Mittel","1","2","3","4","5","6"\r\n"Größe",1,2,3,4,5,6\r\n\r\n',
    ],
)
def test_lines_below_the_last_row_are_left_out_with_one_remark(tmp_path, footer):
    """Texts and statistics of the columns at the end of a CSV file are no samples."""
    (tmp_path / "x.csv").write_text(text_log().rstrip("\n") + footer, encoding="utf-8")
    (found,) = read_logs(tmp_path / "x.csv", JOINTS)
    check(found, "x")
    assert found.remarks == (
        f"the last 2 lines are no rows and were left out: {footer.split(chr(10))[1].rstrip()[:30]}",
    )


@pytest.mark.parametrize("place", ["above", "below", "comment"])
def test_a_line_of_units_counts_at_each_place_beside_the_header(tmp_path, place):
    """A line of units above or below the header, or in a comment, is not ignored.

    It states mNm for the torques here. Torques are expected in Nm, so the error advises to state `units: {tau: mNm}`.
    """
    lines = text_log().splitlines()
    units = UNIT_LINE.replace("Nm", "mNm")
    head = {"above": [units, lines[0]], "below": [lines[0], units, "measured" + ",measured" * 6]}
    lines = [*head.get(place, [f"# {units}", lines[0]]), *lines[1:]]
    (tmp_path / "x.csv").write_text("\n".join(lines) + "\n")
    with pytest.raises(LogError, match=r"write .units: \{tau: mNm\}"):
        read_logs(tmp_path / "x.csv", JOINTS)


@pytest.mark.parametrize("appended", ["", "\ufeff"])
def test_each_part_of_an_appended_file_has_its_own_lines_of_units(tmp_path, appended):
    lines = text_log().splitlines()
    part = "\n".join([lines[0], UNIT_LINE, *lines[1:]]) + "\n"
    (tmp_path / "x.csv").write_text(part + appended + part, encoding="utf-8")
    found = read_logs(tmp_path / "x.csv", JOINTS)
    assert [x.name for x in found] == ["1", "2"]
    for x in found:
        np.testing.assert_array_equal(x.q, found[0].q)


def test_a_cell_that_is_no_number_is_reported_with_its_row(tmp_path):
    (tmp_path / "x.csv").write_text(text_log().replace("-0.23", "o.23"))
    with pytest.raises(LogError) as caught:
        read_logs(tmp_path / "x.csv", JOINTS)
    assert (
        str(caught.value) == f"{tmp_path / 'x.csv'}:4: row 3, column q_elbow: got 'o.23', expected a number; "
        "remove that row"
    )


def test_finiteness_counts_after_units(tmp_path):
    path = parquet(tmp_path / "x.parquet", columns(tau_elbow=TAU[:, 1] * 1e300))
    mapping = {"joints": {"elbow": {"gain": 1e12}}}
    with pytest.raises(LogError, match=r"row 1, column tau_elbow: got no finite number \(4 of 4 rows"):
        read_logs(path, JOINTS, mapping)
    with pytest.raises(
        LogError, match=r"row 1, column tau_elbow: got 6e\+300 in SI units .* below 1e\+09; check"
    ):
        read_logs(path, JOINTS)
    small = {"joints": {"elbow": {"gain": 1e-300}}}
    check(read_logs(path, JOINTS, small)[0], "x", rtol=1e-12)


ODD_ARRAYS = {
    "complex": (Q[:, 0].astype(complex), "unreadable npz file"),
    "records": (np.zeros(4, dtype=[("a", "f8")]), r"a structured array \(a\), .*store its fields"),
    "bytes": (np.zeros(4, "V3"), "unreadable npz file"),
    "text": (np.array(["a"] * 4), "row 1, column q_shoulder: got 'a', expected a number"),
}


@pytest.mark.parametrize("case", ODD_ARRAYS)
def test_unsupported_arrays_are_refused(tmp_path, case):
    array, message = ODD_ARRAYS[case]
    np.savez(tmp_path / "x.npz", **columns(q_shoulder=array))
    with pytest.raises(LogError, match=message):
        read_logs(tmp_path / "x.npz", JOINTS)


@pytest.mark.parametrize("kind", [">f8", np.longdouble, np.float32])
def test_numbers_of_any_machine_are_read(tmp_path, kind):
    np.savez(tmp_path / "x.npz", **columns(q_shoulder=Q[:, 0].astype(kind)))
    check(read_logs(tmp_path / "x.npz", JOINTS)[0], "x", rtol=1e-6)


@pytest.mark.parametrize("kind", [pa.duration("ns"), pa.time64("ns"), pa.timestamp("ns", "UTC")])
def test_clocks_of_any_type_are_read(tmp_path, kind):
    path = parquet(tmp_path / "x.parquet", columns(t=pa.array((T * 1e9).round().astype(np.int64), kind)))
    check(read_logs(path, JOINTS)[0], "x", rtol=1e-9)


def test_lists_do_not_name_recordings(tmp_path):
    path = parquet(tmp_path / "x.parquet", columns(trajectory=pa.array([[1, 2]] * 4)))
    with pytest.raises(LogError, match=r"column trajectory: got values of type list<.*>, expected names"):
        read_logs(path, JOINTS)


@pytest.mark.parametrize("form", ["[{}, {}]", "({} {})", "array('d', [{}, {}])"])
def test_places_of_lists_are_columns(tmp_path, form):
    """Elements of list columns are addressed by index: a cell has the values of all joints, as in JointState."""
    mapping = {
        "columns": {"t": "time"},
        "joints": {
            "shoulder": {"columns": {"q": "position[1]", "qd": "velocity[1]", "tau": "effort[1]"}},
            "elbow": {"columns": {"q": "position[0]", "qd": "velocity[0]", "tau": "effort[0]"}},
        },
    }
    lists = {"position": Q, "velocity": QD, "effort": TAU}
    texts = {name: [form.format(*row[::-1]) for row in values] for name, values in lists.items()}
    nested = {name: pa.array(values[:, ::-1].tolist()) for name, values in lists.items()}
    with (tmp_path / "x.csv").open("w", newline="") as file:
        csv.writer(file).writerows([["time", *texts], *zip(T, *texts.values(), strict=True)])
    parquet(tmp_path / "y.parquet", {"time": T} | nested)
    for name in ("x.csv", "y.parquet"):
        check(read_logs(tmp_path / name, JOINTS, mapping)[0], name[0])
    texts["effort"][2] = "[]"
    with (tmp_path / "x.csv").open("w", newline="") as file:
        csv.writer(file).writerows([["time", *texts], *zip(T, *texts.values(), strict=True)])
    with pytest.raises(LogError, match=r"x\.csv:4: row 3, column effort\[1\]: got no finite number"):
        read_logs(tmp_path / "x.csv", JOINTS, mapping)


OF_ROW = {
    "another arm at the same times": lambda k: [JOINTS, ("left_shoulder", "left_elbow")],
    "another arm in the first row": lambda k: [("left_shoulder", "left_elbow"), JOINTS],
    "a hand in some rows": lambda k: [JOINTS, ("thumb", "index", "ring")][: 1 + (k % 3 == 1)],
    "a gripper in some rows": lambda k: [JOINTS + ("gripper",) * (k % 2)],
    "another order in some rows": lambda k: [JOINTS[:: 1 - 2 * (k % 3 == 1)]],
}
"""Lists of joint names of the rows at the time step k."""


@pytest.mark.parametrize("rows", OF_ROW)
@pytest.mark.parametrize("suffix", ["jsonl", "csv", "parquet", "cells.csv", "cells.parquet"])
def test_values_of_a_row_are_those_of_the_joints_that_it_names(tmp_path, rows, suffix):
    """Each value is assigned by the joint name in its row, if rows have other names or their joints in another order.

    The values of grippers, hands and other arms in the same log are ignored.
    """
    t = 0.01 * np.arange(40)
    q = np.stack([np.sin(5 * t), 2 + np.cos(7 * t)], axis=1)
    log = []
    for k, now in enumerate(t):
        for names in OF_ROW[rows](k):
            values = np.array([q[k, JOINTS.index(x)] if x in JOINTS else 9.0 - 0.01 * k for x in names])
            lists = {"position": values, "velocity": values + 1, "effort": values + 2}
            log.append({"time": now, "name": list(names)} | {x: y.tolist() for x, y in lists.items()})
    path = tmp_path / f"x.{suffix}"
    if suffix.startswith("cells"):
        log = [
            {"time": row.pop("time")}
            | {f"{x}{k}": y for x, cells in row.items() for k, y in enumerate(cells)}
            for row in log
        ]
        table = pa.Table.from_pydict({x: [row.get(x) for row in log] for x in max(log, key=len)})
        (pa.parquet.write_table if suffix.endswith("parquet") else pa.csv.write_csv)(table, path)
    elif suffix == "jsonl":
        path.write_text("\n".join(map(json.dumps, log)))
    elif suffix == "parquet":
        pa.parquet.write_table(pa.Table.from_pylist(log), path)
    else:
        pa.csv.write_csv(pa.Table.from_pylist([{x: str(y) for x, y in row.items()} for row in log]), path)
    (found,) = read_logs(path, JOINTS, yaml.safe_load(suggest_mapping(path, JOINTS).text))
    np.testing.assert_allclose(found.t, t, atol=1e-9)
    for values, expected in ((found.q, q), (found.qd, q + 1), (found.tau, q + 2)):
        np.testing.assert_array_equal(values, expected)


def test_lists_of_words_beside_columns_of_joints_are_no_names(tmp_path):
    """A column with lists of words, such as tags, has no influence on columns with a joint each."""
    tags = [["good", "fast"], ["slow", "far"], ["good", "fast"], ["near", "slow"]]
    check(read_logs(parquet(tmp_path / "x.parquet", columns(tags=tags)), JOINTS)[0], "x")
    check(
        read_logs(
            tmp_path / "x.parquet",
            JOINTS,
            yaml.safe_load(suggest_mapping(tmp_path / "x.parquet", JOINTS).text),
        )[0],
        "x",
    )


def test_rows_of_two_arms_with_unknown_names_are_an_error(tmp_path):
    """If rows are of two arms and no joint name identifies one of them, the names in the log are asked for."""
    state = {"position": [0.1, 0.2], "velocity": [0.3, 0.4], "effort": [0.5, 0.6]}
    log = [{"time": 0.01 * k, "name": [f"{'lr'[k % 2]}_{x}" for x in "ab"]} | state for k in range(40)]
    path = tmp_path / "x.jsonl"
    path.write_text("\n".join(map(json.dumps, log)))
    mapping = {
        "columns": {"t": "time"},
        "joints": {
            x: {"columns": {"q": f"position[{k}]", "qd": f"velocity[{k}]", "tau": f"effort[{k}]"}}
            for k, x in enumerate(JOINTS)
        },
    }
    with pytest.raises(
        LogError, match="got joint states of l_a, l_b and of r_a, r_b, expected shoulder, elbow"
    ):
        read_logs(path, JOINTS, mapping)
    for joint, name in zip(JOINTS, ("r_a", "r_b"), strict=True):
        mapping["joints"][joint]["name"] = name
    (found,) = read_logs(path, JOINTS, mapping)
    np.testing.assert_allclose(found.t, 0.01 + 0.02 * np.arange(20), atol=1e-9)


def test_no_column_of_another_joint_is_offered(tmp_path):
    joints = tuple(str(k) for k in range(6))
    names = {"q": "position_{joint}", "qd": "velocity_{joint}", "tau": "effort_{joint}"}
    log = {"t": T} | {pattern.replace("{joint}", k): T for pattern in names.values() for k in joints}
    del log["effort_3"]
    path = parquet(tmp_path / "x.parquet", log)
    for asked in (joints, ("3",)):
        with pytest.raises(LogError, match="missing column effort_3") as caught:
            read_logs(path, asked, {"columns": names})
        assert "rename the column '" not in str(caught.value)


def test_accelerations_are_not_offered_as_torques(tmp_path):
    names = [f"{quantity}_{joint}" for quantity in ("q", "qd", "qdd") for joint in JOINTS]
    path = parquet(tmp_path / "x.parquet", {"t": T} | {name: T for name in names})
    with pytest.raises(LogError, match="missing columns tau_shoulder, tau_elbow") as caught:
        read_logs(path, JOINTS)
    assert "rename the column '" not in str(caught.value)


def joint_states(order=("b", "a")):
    """Return 50 lines in the format of `ros2 topic echo --csv` of JointState messages at 100 Hz."""
    lines = []
    for k in range(50):
        values = {"a": (0.01 * k, 1.0, 5.0 + 0.1 * k), "b": (-0.02 * k, -2.0, 7.0)}
        cells = [str(1_700_000_000 + k // 100), str(10_000_000 * (k % 100)), "base", *order]
        for field in range(3):
            cells += [f"{values[joint][field]:.6f}" for joint in order]
        lines.append(",".join(cells))
    return lines


def test_output_of_ros2_topic_echo_is_read(tmp_path):
    (tmp_path / "log.csv").write_text("\n".join(joint_states()) + "\n")
    (log,) = read_logs([tmp_path / "log.csv"], ("a", "b"))
    np.testing.assert_allclose(log.t - log.t[0], 0.01 * np.arange(50), atol=1e-9)
    np.testing.assert_allclose(log.q[:, 1], -0.02 * np.arange(50), atol=1e-9)
    np.testing.assert_allclose(log.tau[:, 0], 5.0 + 0.1 * np.arange(50), atol=1e-9)
    # In files with a header, a repeated first line begins a new recording. The output of this command has no header:
    # its first line is a message, which may be received twice. The file is still one recording.
    lines = joint_states()
    (tmp_path / "log.csv").write_text("\n".join([lines[0], *lines]) + "\n")
    assert len(read_logs([tmp_path / "log.csv"], ("a", "b"))) == 1
    # columns of joints that the arm does not have, such as a gripper, are omitted
    (arm_alone,) = read_logs([tmp_path / "log.csv"], ("a",))
    assert arm_alone.q.shape == (50, 1)


def test_a_headerless_csv_is_called_that(tmp_path):
    (tmp_path / "log.csv").write_text("0.00,0.1,0.2,0.3\n0.01,0.1,0.2,0.3\n")
    with pytest.raises(LogError) as caught:
        read_logs([tmp_path / "log.csv"], ("a",))
    assert "log.csv:1: got numbers in the first line (0.00, 0.1, 0.2, ...), expected a header" in str(
        caught.value
    )


def test_numbers_before_words_are_no_joint_states(tmp_path):
    (tmp_path / "log.csv").write_text("1,2,foo,bar\n1,2,3,4\n")
    with pytest.raises(LogError, match="got numbers in the first line"):
        read_logs([tmp_path / "log.csv"], ("a",))


def test_rows_out_of_order_repeated_rows_and_dates_are_mended(tmp_path):
    t = 1.7e9 + 0.01 * np.arange(200)
    columns = {"t": t, "q_a": np.sin(t), "qd_a": np.cos(t), "tau_a": -np.sin(t)}
    order = np.arange(200)
    order[[50, 51]] = 51, 50
    order = np.insert(order, 100, [100, 100])
    table = pa.table({name: values[order] for name, values in columns.items()})
    pa.parquet.write_table(table, tmp_path / "log.parquet")
    (log,) = read_logs([tmp_path / "log.parquet"], ("a",))
    np.testing.assert_allclose(log.q[:, 0], np.sin(t), atol=1e-6)
    assert 0 <= log.t[0] < 1
    notes = [x.message for x in checks.check([log], ("a",), ("revolute",)) if x.code == "repaired"]
    assert notes == [
        "1 time before that of the row above: the rows were sorted",
        "2 rows with the time of the row before left out",
    ]


@pytest.mark.parametrize("rows", [range(30), range(100, 110), range(195, 200)])
def test_rows_whose_times_are_years_from_the_others_are_left_out(tmp_path, rows):
    t = 1.7e9 + 0.01 * np.arange(200)
    stamps = np.where(np.isin(np.arange(200), rows), 0.0, t)
    table = {"t": stamps, "q_a": np.sin(t), "qd_a": np.cos(t), "tau_a": -np.sin(t)}
    (log,) = read_logs(parquet(tmp_path / "log.parquet", table), ("a",))
    np.testing.assert_array_equal(log.q[:, 0], np.delete(np.sin(t), rows))
    assert 0 <= log.t[0] < log.t[-1] < 3
    assert log.repairs == (f"{len(rows)} rows left out, with times far from those of all other rows",)


def test_rows_with_a_hole_are_an_error_until_dropouts_are_dropped(tmp_path):
    t = 0.01 * np.arange(200)
    tau = np.where(np.arange(200) % 5 == 0, np.nan, np.sin(t))
    path = parquet(tmp_path / "log.parquet", {"t": t, "q_a": np.sin(t), "qd_a": np.cos(t), "tau_a": tau})
    with pytest.raises(LogError, match=r"40 of 200 rows .*'dropouts: dropped' under 'logs'"):
        read_logs(path, ("a",))
    (log,) = read_logs(path, ("a",), {"dropouts": "dropped"})
    np.testing.assert_array_equal(log.t, t[~np.isnan(tau)])
    assert log.repairs == ("40 rows left out, with a signal without a number",)


def test_dropouts_are_removed_on_request(tmp_path):
    t = 0.01 * np.arange(200)
    q = 1 + 0.3 * np.sin(t)
    q[[40, 41, 120]] = 0
    pa.parquet.write_table(
        pa.table({"t": t, "q_a": q, "qd_a": 0.3 * np.cos(t), "tau_a": q}), tmp_path / "log.parquet"
    )
    (log,) = read_logs([tmp_path / "log.parquet"], ("a",))
    with pytest.raises(LogError, match=r"falls to 0, in 3 samples, at t = 0\.4, 0\.41, 1\.2 s"):
        checks.check([log], ("a",), ("revolute",))
    (mended,) = read_logs([tmp_path / "log.parquet"], ("a",), {"dropouts": "dropped"})
    assert len(mended) == 197
    assert [x.code for x in checks.check([mended], ("a",), ("revolute",))] == ["repaired"]


def test_a_joint_that_is_not_logged_is_named_with_what_to_write(tmp_path):
    (tmp_path / "log.csv").write_text("t,q_a,qd_a,tau_a\n0,0,0,0\n0.1,0,0,0\n")
    with pytest.raises(LogError, match="moving_joints"):
        read_logs([tmp_path / "log.csv"], ("a", "gripper"))


def clock_texts(kind, seconds):
    hours = 10 if kind != "midnight" else 23.9995
    texts = []
    for x in seconds.tolist():
        time = dt.datetime(2026, 2, 28) + dt.timedelta(hours=hours, seconds=round(x, 3))
        fraction = f"{time.microsecond // 1000:03d}"
        texts.append(
            {
                "clock": f"{time:%H:%M:%S}.{fraction}",
                "midnight": f"{time:%H:%M:%S}.{fraction}",
                "date": f"{time:%Y-%m-%d %H:%M:%S}.{fraction}",
                "minutes": f"{time:%M:%S}.{fraction}",
                "ms": f"{1000 * x:.0f} ms",
                "us": f"{1e6 * x:.0f}µs",
                "s": f"{x:.2f} s",
                "sec": f"{x:.3f} sec",
            }[kind]
        )
    return texts


@pytest.mark.parametrize("form", ["csv", "parquet"])
@pytest.mark.parametrize("kind", ["clock", "midnight", "date", "minutes", "ms", "us", "s", "sec"])
def test_times_as_texts_of_a_clock_or_with_a_unit_are_read(tmp_path, kind, form):
    seconds = 0.01 * np.arange(400)
    values = {f"{name}_a": np.sin(seconds + k) for k, name in enumerate(("q", "qd", "tau"))}
    path = tmp_path / f"log.{form}"
    table = pa.table({"t": clock_texts(kind, seconds), **values})
    (pa.csv.write_csv if form == "csv" else pa.parquet.write_table)(table, path)
    (log,) = read_logs(path, ["a"])
    np.testing.assert_allclose(log.t - log.t[0], seconds, atol=1e-6)
    np.testing.assert_allclose(log.q[:, 0], np.sin(seconds), rtol=1e-12)


def test_cells_with_units_are_errors_with_what_to_do_and_a_second_header_begins_a_recording(tmp_path):
    rows = ["t,q_a,qd_a,tau_a", "0,0.1,0,1", "0.1,0.2 rad,0,1"]
    (tmp_path / "log.csv").write_text("\n".join(rows) + "\n")
    with pytest.raises(
        LogError, match=r"row 2, column q_a: got '0.2 rad', .*; write numbers only, and the unit as"
    ):
        read_logs(tmp_path / "log.csv", ["a"])
    (tmp_path / "log.csv").write_text("\n".join([*rows[:2], rows[0], rows[1]]) + "\n")
    assert [len(x) for x in read_logs(tmp_path / "log.csv", ["a"])] == [1, 1]


def test_the_encoding_of_a_long_file_is_found_in_its_head(tmp_path):
    rows = [f"{0.01 * k:.2f},0.1,0.2,1.0" for k in range(8000)]
    (tmp_path / "log.csv").write_bytes("\n".join(["t,q °,qd,tau", *rows, ""]).encode("latin-1"))
    mapping = LogMapping.model_validate({"columns": {"q": "q °", "qd": "qd", "tau": "tau"}})
    assert len(read_logs(tmp_path / "log.csv", ["a"], mapping)[0]) == 8000


def test_separators_of_thousands_are_an_error_with_what_to_do(tmp_path):
    (tmp_path / "log.csv").write_text('t,q_a,qd_a,tau_a\n1,0.1,0,1\n2,0.2,0,"1,002.5"\n')
    with pytest.raises(
        LogError, match=r"got '1,002.5', expected a number; write numbers without separators of thou"
    ):
        read_logs(tmp_path / "log.csv", ["a"])


def test_vectors_of_matlab_and_conversions_of_other_files(tmp_path, monkeypatch):
    """Files .mat, .npy and .txt are refused, and the command in the error message converts them to readable logs."""
    import scipy.io

    monkeypatch.chdir(tmp_path)
    scipy.io.savemat("m.mat", columns(t=T[:, None]))
    np.save("n.npy", np.column_stack([T, Q, QD, TAU]))
    Path("t.txt").write_text(text_log())
    for name, log in (("m.mat", "m.json"), ("n.npy", "n.csv"), ("t.txt", "t.csv")):
        with pytest.raises(LogError, match="; convert it: ") as caught:
            read_logs(name, JOINTS)
        command = str(caught.value).split("convert it: ")[1].replace("python", sys.executable)
        subprocess.run(command.replace("NAMES", ",".join(columns())), shell=True, check=True)
        check(read_logs(log, JOINTS)[0], log[0])
    np.savez("x.npz", data=np.column_stack([T, Q, QD, TAU]))
    joints = {
        joint: {"columns": {x: f"data[{1 + 2 * k + row}]" for k, x in enumerate(("q", "qd", "tau"))}}
        for row, joint in enumerate(JOINTS)
    }
    check(read_logs("x.npz", JOINTS, {"columns": {"t": "data[0]"}, "joints": joints})[0], "x")
    np.savez("x.npz", t=T, q=np.stack([Q, Q]), qd=QD, tau=TAU)
    with pytest.raises(
        LogError, match=r"array q: got an array of shape \(2, 4, 2\), .*; store an array per recording"
    ):
        read_logs("x.npz", JOINTS)


def test_json_lines_structs_stamps_in_two_columns_and_logs_without_times(tmp_path):
    lines = [
        {
            "sec": 17,
            "nsec": round(t * 1e9),
            **{x: dict(zip(JOINTS, values, strict=True)) for x, values in row.items()},
        }
        for t, *row in zip(T.tolist(), Q.tolist(), QD.tolist(), TAU.tolist(), strict=True)
        for row in [dict(zip(("q", "qd", "tau"), row, strict=True))]
    ]
    (tmp_path / "x.jsonl").write_text("".join(f"{json.dumps(line)}\n" for line in lines))
    parquet(tmp_path / "y.parquet", pa.Table.from_pylist(lines))
    names = {x: f"{x}.{{joint}}" for x in ("q", "qd", "tau")}
    for file in ("x.jsonl", "y.parquet"):
        (found,) = read_logs(tmp_path / file, JOINTS, {"columns": {"t": "sec + nsec", **names}})
        check(found, file[0], rtol=1e-12)
        (found,) = read_logs(tmp_path / file, JOINTS, {"columns": names, "sample_rate": 100})
        check(found, file[0], rtol=1e-12)
        with pytest.raises(
            LogError, match=r"missing column t: .*; write its name as .*, or 'sample_rate: HZ'"
        ):
            read_logs(tmp_path / file, JOINTS, {"columns": names})


def test_columns_separated_by_spaces_are_read(tmp_path):
    (tmp_path / "log.csv").write_text("t q_a qd_a tau_a\n0 0.1 0 1\n0.1 0.2 0 1\n")
    np.testing.assert_array_equal(read_logs(tmp_path / "log.csv", ["a"])[0].q[:, 0], [0.1, 0.2])


@pytest.mark.parametrize("name", ["my log.txt", "a'); import os; (b.npy", 'a"; ls; ".mat', "$(ls).xlsx"])
def test_a_path_is_no_code_in_an_advised_command(tmp_path, name):
    path = tmp_path / name
    path.touch()
    with pytest.raises(LogError) as caught:
        read_logs(path, JOINTS)
    command = str(caught.value).split("convert it: ")[1]
    assert "FILE" in command and path.stem not in command


def test_columns_without_numbers_and_dashes_have_a_remedy_that_works(tmp_path):
    """A log with one dash instead of a value is read with the advised `dropouts: dropped`.

    For a column of dashes only, which would remove all rows, the advice is to name another column.
    """
    lines = text_log().splitlines()
    rows = [line.rpartition(",")[0] for line in lines]
    (tmp_path / "x.csv").write_text("\n".join([lines[0], *(f"{x},-" for x in rows[1:])]))
    with pytest.raises(LogError, match="name a column with values in place of tau_elbow") as caught:
        read_logs(tmp_path / "x.csv", JOINTS)
    assert "dropouts" not in str(caught.value)
    (tmp_path / "x.csv").write_text("\n".join([*lines[:2], f"{rows[2]},-", *lines[3:]]))
    with pytest.raises(LogError, match=r"no finite number \(1 of .*'dropouts: dropped'"):
        read_logs(tmp_path / "x.csv", JOINTS)
    assert len(read_logs(tmp_path / "x.csv", JOINTS, {"dropouts": "dropped"})[0]) == len(lines) - 2


def test_dates_in_another_order_are_an_error_with_the_form_to_write(tmp_path):
    for text in ("10/26/2025 11:59:56.5 PM", "26.10.2025 23:59:56.5", "11:59:56:500"):
        (tmp_path / "x.csv").write_text(f"t,q_a,qd_a,tau_a\n{text},0,0,0\n")
        with pytest.raises(LogError, match="write times as numbers, or like 2025-10-26"):
            read_logs(tmp_path / "x.csv", ["a"])


def test_a_pointer_of_git_lfs_is_called_so(tmp_path):
    (tmp_path / "x.parquet").write_text("version https://git-lfs.github.com/spec/v1\noid sha256:a\nsize 1\n")
    with pytest.raises(
        LogError, match="a pointer of Git LFS in place of the file; fetch the content: git lfs pull"
    ):
        read_logs(tmp_path / "x.parquet", JOINTS)


def test_the_cut_last_line_of_json_lines_is_left_out(tmp_path):
    rows = [json.dumps({"t": 0.01 * k, "q_a": k % 7, "qd_a": 0.5, "tau_a": 0.1 * k}) for k in range(20)]
    (tmp_path / "x.jsonl").write_text("\n".join([*rows, rows[-1][:11]]))
    (log,) = read_logs(tmp_path / "x.jsonl", ["a"])
    assert len(log) == 20
    assert log.remarks == (f"the last line is cut off and was left out: {rows[-1][:11]}",)
