"""States of an arm in several messages, topics or rows are joined at the times of the signal with the lowest rate."""

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet
import pytest
from test_good_data import START, STATE, joint_state

from spelgen.arm.configured_arm import load_arm
from spelgen.errors import LogError
from spelgen.logs.read import read_logs

ROBOTS = ("two_link", "rpr", "ur10e")
FIELDS = ("q", "qd", "tau")


def motion(seed, joints):
    """Return smooth signals as a function of times (T,): q, qd and tau, (3, T, n)."""
    rng = np.random.default_rng(seed)
    omega, phase = rng.uniform(0.5, 2.0, joints), rng.uniform(0, 6, joints)

    def signals(t):
        angle = omega * t[:, None] + phase
        return np.stack([np.sin(angle), omega * np.cos(angle), 3 * np.sin(2 * angle)])

    return signals


@pytest.fixture(params=ROBOTS)
def joints(request, robots):
    return tuple(load_arm(robots / f"{request.param}.urdf").chain.joint_names)


def parts_of(joints, rng):
    """Split joints at random into two non-empty groups; return their indices."""
    order = rng.permutation(len(joints))
    cut = int(rng.integers(1, len(joints)))
    return order[:cut], order[cut:]


def write_bag(folder, messages):
    """Write a bag of JointState messages (time [ns], topic, names, q, qd, tau)."""
    pytest.importorskip("rosbags", reason="reading bags needs the extra 'ros'")
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        topics = sorted({topic for _, topic, *_ in messages})
        connections = {x: writer.add_connection(x, STATE, typestore=store) for x in topics}
        for time, topic, *values in sorted(messages, key=lambda x: x[0]):
            message = store.serialize_cdr(joint_state(store, START + time, *values), STATE)
            writer.write(connections[topic], START + time + 777, message)
    return folder


@pytest.mark.parametrize("topics", [("/joint_states", "/joint_states"), ("/base", "/wrist")])
@pytest.mark.parametrize("clocks", ["equal", "shifted", "of different rates"])
def test_joints_in_two_messages_are_joined(joints, topics, clocks, tmp_path):
    rng = np.random.default_rng(sum(map(ord, clocks + topics[0])) + len(joints))
    signals = motion(int(rng.integers(1000)), len(joints))
    # [ms] period of the messages of the first and of the second topic
    steps = {"equal": (10, 10), "shifted": (10, 10), "of different rates": (4, 10)}[clocks]
    shift = 0 if clocks == "equal" else 3
    messages = []
    for part, topic, step, first in zip(parts_of(joints, rng), topics, steps, (0, shift), strict=True):
        times = np.arange(first, 4000, step)
        values = signals(times * 1e-3)[..., part]
        names = [joints[k] for k in part]
        for k, time in enumerate(times.tolist()):
            messages.append((time * 1_000_000, topic, names, *values[:, k]))
    (log,) = read_logs(write_bag(tmp_path / "bag", messages), joints)
    assert len(log) >= 398 and log.sample_rate == pytest.approx(100, rel=1e-3)
    start = (
        0 if abs(log.q - signals(log.t)[0]).max() < 1e-3 else shift * 1e-3
    )  # times of the log count from its first message
    for name, values in zip(FIELDS, signals(log.t + start), strict=True):
        np.testing.assert_allclose(
            getattr(log, name), values, atol=0.0 if clocks == "equal" else 1e-3, rtol=1e-9
        )
    assert any("separate rows" in x for x in log.repairs) or clocks == "equal"


def test_a_gap_of_one_message_is_a_gap_of_the_log(joints, tmp_path):
    signals, times = motion(1, len(joints)), np.arange(0, 4000, 10)
    first, second = parts_of(joints, np.random.default_rng(2))
    messages = []
    for part, shift in ((first, 0), (second, 4)):
        for time in (times + shift).tolist():
            if not (shift and 1000 < time < 1500):
                values = signals(np.array([1e-3 * time]))[:, 0, part]
                messages.append((time * 1_000_000, "/joint_states", [joints[k] for k in part], *values))
    (log,) = read_logs(write_bag(tmp_path / "bag", messages), joints)
    np.testing.assert_allclose(log.q, signals(log.t)[0], atol=0.05)
    assert np.diff(log.t).max() > 0.4


@pytest.mark.parametrize("form", ["csv", "parquet"])
def test_topics_in_rows_of_one_file_are_joined(joints, form, tmp_path):
    """Rows of several topics in one table, with empty cells in the columns of other topics, are joined."""
    rng = np.random.default_rng(len(joints))
    signals = motion(3, len(joints))
    # sample times of q and qd, and sample times of torques
    times = [np.arange(0.0, 4.0, 0.01), np.arange(0.002, 4.0, 0.005)]
    t = np.concatenate(times)
    rows = np.full((3, len(t), len(joints)), np.nan)
    rows[:2, : len(times[0])] = signals(times[0])[:2]
    rows[2, len(times[0]) :] = signals(times[1])[2]
    order = np.argsort(t)
    columns = {"t": t[order]}
    for name, values in zip(FIELDS, rows[:, order], strict=True):
        for joint, column in zip(joints, values.T, strict=True):
            columns[f"{name}_{joint}"] = pa.array(column, mask=np.isnan(column))
    table, path = pa.table(columns), tmp_path / f"log.{form}"
    (pa.csv.write_csv if form == "csv" else pa.parquet.write_table)(table, path)
    (log,) = read_logs(path, joints)
    assert log.sample_rate == pytest.approx(100, rel=1e-3)
    for name, values in zip(FIELDS, signals(log.t), strict=True):
        np.testing.assert_allclose(getattr(log, name), values, atol=2e-3)
    assert log.repairs == (
        "signals in separate rows or messages: interpolated at the times of the rarest one",
    )
    # only every third row has torques
    kept = np.arange(len(times[0])) % 3 == rng.integers(3)
    columns = {"t": times[0]}
    for name, values in zip(FIELDS, signals(times[0]), strict=True):
        for joint, column in zip(joints, values.T, strict=True):
            columns[f"{name}_{joint}"] = pa.array(column, mask=~kept & (name == "tau"))
    (pa.csv.write_csv if form == "csv" else pa.parquet.write_table)(pa.table(columns), path)
    (log,) = read_logs(path, joints)
    np.testing.assert_allclose(log.q, signals(times[0][kept])[0], rtol=1e-9)
    assert log.repairs == (
        f"{np.sum(~kept)} rows without all signals left out: of other joints, or signals have different rates",
    )


def test_a_joint_that_no_message_contains_is_named(joints, tmp_path):
    signals = motion(4, len(joints))(np.arange(0, 1, 0.01))
    messages = []
    for k in range(100):
        messages.append((10_000_000 * k, "/joint_states", joints[1:], *signals[:, k, 1:]))
    with pytest.raises(LogError, match=f"joint states without {joints[0]}"):
        read_logs(write_bag(tmp_path / "bag", messages), joints)


def test_a_few_partial_messages_are_left_out(joints, tmp_path):
    signals = motion(5, len(joints))(np.arange(0, 1, 0.01))
    messages = [(10_000_000 * k, "/joint_states", joints, *signals[:, k]) for k in range(100)]
    messages.append((995_000_000, "/joint_states", joints[:1], *signals[:, 0, :1]))
    (log,) = read_logs(write_bag(tmp_path / "bag", messages), joints)
    np.testing.assert_array_equal(log.q, signals[0])
    assert log.remarks == ("1 message without all joints left out",)
