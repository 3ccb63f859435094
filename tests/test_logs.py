"""Logs are read exactly, filtered without delay, split without leakage, and refused with one clear error."""

import re
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from time import process_time

import numpy as np
import pyarrow as pa
import pyarrow.parquet
import pytest
import torch

from spelgen.arm.configured_arm import load_arm
from spelgen.emission.build import build
from spelgen.errors import LogError, SpelgenErrors
from spelgen.logs.checks import check
from spelgen.logs.filtering import low_pass, regular_times, resampled
from spelgen.logs.preprocessing import Preprocessing
from spelgen.logs.read import Trajectory, read_logs, write_logs
from spelgen.logs.trajectory import split_at_gaps
from spelgen.logs.tuning import shows_accelerations
from spelgen.logs.windows import cut_windows, split_validation
from spelgen.settings.log_mapping import LogMapping

JOINTS = ("a", "b")


def swing(name="swing", samples=200, dt=0.01, jitter=0.0, seed=0) -> Trajectory:
    """Return a log of two joints that swing at 0.5 and 0.8 Hz, with arbitrary torques.

    dt: sampling interval [s]. jitter: largest relative change of an interval.
    """
    random = np.random.default_rng(seed)
    t = np.concatenate([[0.0], np.cumsum(dt * (1 + jitter * random.uniform(-1, 1, samples - 1)))])
    frequency = 2 * np.pi * np.array([0.5, 0.8])
    phase = t[:, None] * frequency
    return Trajectory(t, np.sin(phase), frequency * np.cos(phase), 3.0 * np.cos(phase), name)


class TestTrajectory:
    @pytest.mark.parametrize(
        "kind", [np.ndarray.tolist, np.float32, torch.tensor, lambda x: torch.tensor(x).requires_grad_()]
    )
    def test_lists_arrays_and_tensors_are_taken(self, kind):
        whole = swing(samples=4)
        found = Trajectory(*(kind(x) for x in (whole.t, whole.q, whole.qd, whole.tau)))
        assert found.name == "trajectory"
        for quantity in ("t", "q", "qd", "tau"):
            assert getattr(found, quantity).dtype == np.float64
            np.testing.assert_allclose(getattr(found, quantity), getattr(whole, quantity), rtol=1e-6)

    @pytest.mark.parametrize(
        ("changes", "message"),
        [
            ({"t": [[0.0], [1.0]]}, "t: got an array of shape (2, 1), expected (T,), a time for each sample"),
            ({"t": []}, "t: got an array of shape (0,), expected (T,), a time for each sample"),
            (
                {"qd": np.zeros((3, 2))},
                "qd: got an array of shape (3, 2), expected (2, 2), a row for each time and a column for each joint",
            ),
            (
                {"q": [1.0, 2.0]},
                "q: got an array of shape (2,), expected (2, n), a row for each time and a column for each joint",
            ),
            (
                {"tau": [[0, 1], [2, float("nan")]]},
                "tau: got [2.0, nan] at sample 1, expected finite numbers",
            ),
            ({"t": [0.1, 0.1]}, "t: got 0.1 s after 0.1 s, expected increasing times"),
        ],
    )
    def test_what_does_not_fit_is_told(self, changes, message):
        arrays = {"t": [0.0, 0.1], "q": np.zeros((2, 2)), "qd": np.zeros((2, 2)), "tau": np.zeros((2, 2))}
        with pytest.raises(LogError) as caught:
            Trajectory(**arrays | changes, name="x")
        assert str(caught.value) == f"trajectory x: {message}"

    def test_words_are_no_numbers(self):
        with pytest.raises(
            LogError, match=r"trajectory trajectory: t: got str \(.*\), expected an array of numbers"
        ):
            Trajectory("name", [0.0], [[0.0]], [[0.0]])

    def test_it_is_told_in_a_line_and_in_a_notebook(self):
        assert repr(swing()) == "<Trajectory 'swing': 200 samples, 1.99 s at 100 Hz, 2 joints>"
        hostile = swing(name="<script>")
        assert "&lt;script&gt;" in hostile._repr_html_() and "<script>" not in hostile._repr_html_()


def test_alternating_rows_of_recordings_are_separated(tmp_path):
    """Alternating rows of 3000 recordings are separated, in time and memory that grow with the number of rows only."""
    names = [f"r{k % 3000}" for k in range(12_000)]
    t, values = np.arange(12_000) // 3000 * 0.1, np.arange(12_000.0)
    columns = {"trajectory": names, "t": t, "q_a": values, "qd_a": values, "tau_a": values}
    pa.parquet.write_table(pa.table(columns), tmp_path / "x.parquet")
    found = read_logs(tmp_path, ["a"])
    assert [x.name for x in found] == [f"r{k}" for k in range(3000)]
    np.testing.assert_array_equal(found[17].q[:, 0], [17, 3017, 6017, 9017])


@pytest.mark.parametrize(("step", "few"), [("read", 500), ("check", 60)])
def test_many_short_recordings_take_time_by_their_number(tmp_path, step, few):
    """The time of reading and checking recordings of two samples is proportional to their number."""
    random, seconds = np.random.default_rng(0), []
    for count in (few, 16 * few):
        logs = [Trajectory([0, 0.01], *random.standard_normal((3, 2, 2)), name=f"r{k}") for k in range(count)]
        write_logs(tmp_path / "x.parquet", logs, JOINTS)
        run = {
            "read": lambda: read_logs(tmp_path / "x.parquet", JOINTS),
            "check": lambda logs=logs: check(logs, JOINTS, ("prismatic",) * 2),
        }[step]
        start = process_time()
        run()
        seconds.append(process_time() - start)
    assert seconds[1] < 60 * max(seconds[0], 0.01)


def csv(path: Path, text: str) -> Path:
    path.write_text(text, encoding="utf-8")
    return path


HEADER = "t,q_a,qd_a,tau_a\n"


@pytest.mark.parametrize("suffix", [".parquet", ".csv"])
def test_what_is_written_is_read_back_exactly(tmp_path, suffix):
    first, second = swing("first", jitter=0.3), swing("second", samples=7, seed=1)
    write_logs(tmp_path / f"logs{suffix}", [first, second], JOINTS)
    found = read_logs([tmp_path / f"logs{suffix}"], JOINTS)
    assert [x.name for x in found] == ["first", "second"]
    for written, read in zip([first, second], found, strict=True):
        for quantity in ("t", "q", "qd", "tau"):
            np.testing.assert_array_equal(getattr(read, quantity), getattr(written, quantity))
    assert [x.name for x in tmp_path.iterdir()] == [f"logs{suffix}"]


def test_joints_are_read_by_name_in_the_order_asked(tmp_path):
    write_logs(tmp_path / "x.parquet", [swing()], JOINTS)
    (found,) = read_logs([tmp_path], ("b", "a"))
    np.testing.assert_array_equal(found.q, swing().q[:, ::-1])


def test_a_folder_gives_the_part_asked_for(tmp_path):
    for name in ("train", "test"):
        write_logs(tmp_path / f"{name}.parquet", [swing(name)], JOINTS)
    (tmp_path / "._train.csv").write_bytes(b"of macOS, no log")
    assert [x.name for x in read_logs([tmp_path], JOINTS, role="train")] == ["train"]
    assert [x.name for x in read_logs([tmp_path], JOINTS, role="test")] == ["test"]
    assert [x.name for x in read_logs([tmp_path], JOINTS)] == ["test", "train"]


def test_names_are_unique_across_files(tmp_path):
    for name in ("monday", "tuesday"):
        write_logs(tmp_path / f"{name}.parquet", [swing("0"), swing("1")], JOINTS)
    names = [x.name for x in read_logs([tmp_path], JOINTS)]
    assert names == ["monday/0", "monday/1", "tuesday/0", "tuesday/1"]


def test_what_cannot_be_written_is_told(tmp_path):
    for path, logs, message in (
        ("x.txt", [swing()], "got a log named 'x.txt', expected .parquet or .csv"),
        ("x.csv", [], "got no trajectory, expected at least one"),
        ("x.csv", [swing()], "trajectory swing: got 2 joints, expected 3: a, b, c"),
    ):
        with pytest.raises(LogError) as caught:
            write_logs(tmp_path / path, logs, ["a", "b", "c"])
        assert str(caught.value) == message
    assert not list(tmp_path.iterdir())


BAD = {
    "empty": ("", "{}: an unreadable csv file (Empty CSV file)"),
    "header-only": (HEADER, "{}: got no rows, expected at least one window of samples"),
    "missing-column": (
        "t,q_a,qd_a,torque_a\n0,0,0,0\n",
        "{}: missing column tau_a: got only the columns t, q_a, qd_a, torque_a, "
        "expected t, q_<joint>, qd_<joint>, tau_<joint>; rename the columns, or write their names under 'logs' in "
        "the robot's YAML: `spelgen logs LOGS --robot ROBOT.urdf --suggest FILE` drafts them",
    ),
    "repeated-column": (
        "t,q_a,q_a,qd_a,tau_a\n0,0,0,0,0\n",
        "{}: column q_a: got the same name for the columns 2, 3, expected it once; rename one of them",
    ),
    "text": (
        HEADER + "0,zero,0,0\n",
        "{}:2: row 1, column q_a: got 'zero', expected a number; remove that row",
    ),
    "hole": (
        HEADER + "0,0,0,0\n0.1,0,,0\n0.2,0,0,nan\n",
        "{}:3: row 2, column qd_a: got no finite number (2 of 3 rows have such a gap, this is the first), "
        "expected a number; 'dropouts: dropped' under 'logs' in the robot's YAML leaves out those rows",
    ),
    "time-back": (
        HEADER + "0,0,0,0\n0.1,1,0,0\n0.2,2,0,0\n0.05,3,0,0\n",
        "{}:5: row 4, column t: got t = 0.05 s after 0.2 s (1 such step, this is the first), "
        "expected increasing times; "
        "number the recordings, in Python: log['trajectory'] = (log['t'].diff() < 0).cumsum()",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_csv_is_refused_in_one_sentence(tmp_path, case):
    content, message = BAD[case]
    path = csv(tmp_path / "log.csv", content)
    with pytest.raises(LogError) as caught:
        read_logs([path], ("a",))
    assert str(caught.value) == message.format(path)


def test_missing_files_and_folders_are_told_at_once(tmp_path):
    (tmp_path / "empty").mkdir()
    csv(tmp_path / "log.txt", "")
    with pytest.raises(SpelgenErrors) as caught:
        read_logs([tmp_path / "none.csv", tmp_path / "empty", tmp_path / "log.txt"], JOINTS)
    kinds = ".parquet, .csv, .tsv, .npz, .jsonl, .ndjson, .json, .mcap, .db3, .bag"
    kinds += ", the folder of a ROS 2 bag or of a LeRobot data set"
    renamed = f"mv {tmp_path}/log.txt {tmp_path}/log.csv"
    assert str(caught.value).splitlines() == [
        f"{tmp_path}/none.csv: got no such file or folder, expected a log; check the path",
        f"{tmp_path}/empty: got a folder without logs, expected {kinds}",
        f"{tmp_path}/log.txt: got a file of kind '.txt', expected {kinds}; convert it: {renamed}",
    ]


def test_a_broken_parquet_file_is_told(tmp_path):
    path = csv(tmp_path / "log.parquet", "not a Parquet file")
    with pytest.raises(LogError, match=r"log\.parquet: an unreadable parquet file \("):
        read_logs([path], JOINTS)


def test_two_recordings_in_one_file_need_a_trajectory_column(tmp_path):
    arrays = {x: np.concatenate([getattr(swing(), x), -getattr(swing(), x)]) for x in ("q", "qd", "tau")}
    columns = {f"{x}_{joint}": values[:, k] for x, values in arrays.items() for k, joint in enumerate(JOINTS)}
    t = np.concatenate([swing().t] * 2)
    pa.parquet.write_table(pa.table({"t": t, **columns}), tmp_path / "x.parquet")
    with pytest.raises(LogError, match=r"row 201, column t: got t = 0 s after 1\.99 s"):
        read_logs([tmp_path], JOINTS)


def scaled(trajectory: Trajectory, q=1.0, qd=1.0) -> Trajectory:
    return Trajectory(trajectory.t, q * trajectory.q, qd * trajectory.qd, trajectory.tau, "x")


DEGREES = {
    "q": (scaled(swing(), q=180 / np.pi), "q from -57.3 to 57.3, more than two turns: q in deg", "{q: deg}"),
    "qd": (
        scaled(swing(), qd=180 / np.pi),
        "q that changes 0.0175 times as fast as qd: qd in deg/s",
        "{qd: deg/s}",
    ),
    "both": (
        scaled(swing(), q=180 / np.pi, qd=180 / np.pi),
        "q from -57.3 to 57.3, more than two turns: q in deg and qd in deg/s",
        "{q: deg, qd: deg/s}",
    ),
    "revolutions": (
        scaled(swing(), q=1 / (2 * np.pi)),
        "q that changes 0.159 times as fast as qd: q in turns",
        "{q: turns}",
    ),
    "degrees and rpm": (
        scaled(swing(), q=180 / np.pi, qd=30 / np.pi),
        "q from -57.3 to 57.3, more than two turns: q in deg and qd in rpm",
        "{q: deg, qd: rpm}",
    ),
}


@pytest.mark.parametrize("case", DEGREES)
def test_degrees_are_refused(case):
    """Positions in degrees are one error about all joints, and one line of settings corrects all of them."""
    trajectory, message, units = DEGREES[case]
    with pytest.raises(LogError) as caught:
        check([trajectory], JOINTS, ("revolute", "revolute"))
    assert str(caught.value) == (
        f"trajectory x, joint 'a', 'b': got {message}, expected rad and rad/s, m and m/s; "
        f"write 'units: {units}' under 'logs' in the robot's YAML; --accept degrees if it is right"
    )


def test_millimetres_of_prismatic_joints_are_refused():
    with pytest.raises(
        LogError, match=r"more than 30 m: q in mm and qd in mm/s.* write 'units: {q: mm, qd: mm/s}'"
    ):
        check([scaled(swing(), q=1000.0, qd=1000.0)], JOINTS, ("prismatic", "prismatic"))
    check([scaled(swing(), q=10.0, qd=10.0)], JOINTS, ("prismatic", "prismatic"))


def test_registers_get_no_unit_by_chance_but_the_lines_that_read_them(tmp_path):
    """Encoder counts and speeds in units of 0.229 rpm (0.024 rad/s) are reported as numbers of an unknown unit.

    They match no common unit, and the ratio 0.024 of dq/dt to qd is not reported as a slow clock. The log is
    read correctly with a mapping that states the counts, and replaces qd by dq/dt (`velocity: differentiated`).
    """
    log = swing()
    registers = replace(
        log, q=np.round(2048 + log.q * 4096 / 2 / np.pi), qd=np.round(log.qd * 60 / 2 / np.pi / 0.229)
    )
    write_logs(tmp_path / "x.parquet", [registers], JOINTS)
    table = pa.parquet.read_table(tmp_path / "x.parquet").replace_schema_metadata(None)
    pa.parquet.write_table(table, tmp_path / "x.parquet")
    counts = {
        "units": {"q": "counts"},
        "joints": {joint: {"counts_per_turn": 4096, "offset": -np.pi} for joint in JOINTS},
    }
    for mapping, expected in (
        ({}, r"counts of an encoder need 'counts_per_turn'\), expected .*; write 'units' under"),
        (
            counts,
            "0.024 times as fast as qd, whole numbers of an unknown unit, .*; write 'velocity: differentiated' un",
        ),
    ):
        with pytest.raises(LogError, match=expected):
            check(read_logs(tmp_path / "x.parquet", JOINTS, mapping), JOINTS, ("revolute", "revolute"))
    found = read_logs(tmp_path / "x.parquet", JOINTS, counts | {"velocity": "differentiated"})
    few = replace(
        log, q=np.round(2048 + 0.05 * log.q * 4096 / 2 / np.pi), mapping=LogMapping(velocity="differentiated")
    )
    with pytest.raises(
        LogError, match=r"counts of an encoder need 'counts_per_turn'\), expected .*; write 'units' under"
    ):
        check([few], JOINTS, ("revolute", "revolute"))
    assert check(found, JOINTS, ("revolute", "revolute")) == []
    np.testing.assert_allclose(found[0].q, log.q, atol=1e-3)


def test_many_turns_are_believed_where_the_units_are_declared(tmp_path):
    spinning = scaled(swing(), q=180 / np.pi, qd=180 / np.pi)
    write_logs(tmp_path / "declared.parquet", [spinning], JOINTS)
    assert check(read_logs([tmp_path], JOINTS), JOINTS, ("revolute", "revolute")) == []
    table = pa.parquet.read_table(tmp_path / "declared.parquet").replace_schema_metadata(None)
    pa.parquet.write_table(table, tmp_path / "declared.parquet")
    with pytest.raises(LogError, match="more than two turns"):
        check(read_logs([tmp_path], JOINTS), JOINTS, ("revolute", "revolute"))


def test_degrees_of_most_joints_are_the_unit_of_a_joint_that_hardly_moves():
    """Without logged velocities, nothing shows that the third joint, which moves by 4 degrees, is in rad."""
    t = swing().t
    q = np.degrees(np.stack([np.sin(3 * t), np.cos(2 * t), 0.2 + 0.03 * np.sin(t)], axis=1))
    mapping = LogMapping(velocity="differentiated")
    log = Trajectory(t, q, np.gradient(q, t, axis=0), np.cos(q), mapping=mapping)
    with pytest.raises(LogError, match=r"'a', 'b': got q .* q in deg, .*; write 'units: \{q: deg\}' under"):
        check([log], ("a", "b", "c"), ("revolute",) * 3)


def test_a_velocity_that_is_no_derivative_is_a_warning():
    (note,) = check([scaled(swing(), qd=np.array([1.0, 1.3]))], JOINTS, ("revolute", "revolute"))
    assert (note.severity, note.code, note.where) == (
        "warning",
        "velocity-is-no-derivative",
        "trajectory x, joint 'b'",
    )
    assert note.message == "qd is not dq/dt: the best factor is 0.769, the correlation 1"


@pytest.mark.parametrize(
    ("matrix", "formula"),
    [
        ([[1, 1], [0, 1]], "dq/dt of joint 'a' + dq/dt of joint 'b'"),
        ([[1, 0.3], [0, 1]], None),
        ([[1, 0], [0.5, -0.5]], "0.5 dq/dt of joint 'a' -0.5 dq/dt of joint 'b'"),
    ],
)
def test_a_velocity_of_the_motors_of_a_coupled_wrist_is_named(matrix, formula):
    log = swing()
    notes = check([replace(log, qd=log.qd @ np.transpose(matrix))], JOINTS, ("revolute", "revolute"))
    assert [x.code for x in notes if formula] == ["velocity-is-no-derivative"] * bool(formula)
    assert all(("of a coupled wrist" in x.message) == bool(formula) for x in notes)
    assert formula is None or f"it is {formula}: " in notes[0].message


def test_times_that_contradict_all_velocities_get_the_rate_of_the_velocities(tmp_path):
    """If the velocities of all joints contradict the time stamps, the error advises the right `sample_rate`.

    The time stamps of the log are 2.5 times as far apart as its samples. A log that is read with the advised rate
    passes the checks.
    """
    sound = swing()
    write_logs(tmp_path / "x.csv", [replace(sound, t=2.5 * sound.t)], JOINTS)
    with pytest.raises(LogError, match=r"'a', 'b': got q that changes 0.4 times as fast as qd") as caught:
        check(read_logs([tmp_path / "x.csv"], JOINTS), JOINTS, ("revolute", "revolute"))
    rate = float(re.search(r"write 'sample_rate: (\S+)'", str(caught.value))[1])
    assert rate == pytest.approx(sound.sample_rate, rel=1e-3)
    logs = read_logs([tmp_path / "x.csv"], JOINTS, {"sample_rate": rate})
    assert check(logs, JOINTS, ("revolute", "revolute")) == []


def changed(q=None, qd=None, tau=None) -> Trajectory:
    """Return the log `swing` with columns of some joints, {joint: value}, set to constants or arrays."""
    arrays = {name: getattr(swing(), name).copy() for name in ("q", "qd", "tau")}
    for array, values in zip(arrays.values(), (q, qd, tau), strict=True):
        for joint, value in (values or {}).items():
            array[:, joint] = value
    return Trajectory(swing().t, **arrays, name="x")


@pytest.mark.parametrize(
    ("trajectory", "got"),
    [
        (changed(qd={0: 0.0}), "qd always 0 while q goes from -1 to 1"),
        (changed(q={0: 0.7}), "q always 0.7 while qd says that it moves by 1"),
    ],
)
def test_a_frozen_column_is_refused(trajectory, got):
    with pytest.raises(LogError) as caught:
        check([trajectory], JOINTS, ("revolute", "revolute"))
    assert str(caught.value) == (
        f"trajectory x, joint 'a': got {got}, expected columns that belong together; "
        "check the logger, and the names of the columns; --accept frozen if it is right"
    )


@pytest.mark.parametrize("step", [0.005, 0.022])
def test_a_joint_at_rest_whose_drive_has_no_word_for_zero_velocity_is_not_frozen(step):
    """Drives with 12 bits for -limit ... limit send velocities of at least half a step, also at rest.

    Their integral grows with time, and the position of the joint at rest is constant or changes by one encoder step.
    """
    log, random = swing(), np.random.default_rng(0)
    t = 0.1 * np.arange(len(log.t))
    qd = step * (random.integers(-1, 2, len(t)) - 0.5)
    for q in (np.full(len(t), 0.7), 0.7 + 4e-4 * (np.arange(len(t)) > 100)):
        resting = Trajectory(t, *(np.column_stack([x, x]) for x in (q, qd, 0.1 + 0 * q)), name="x")
        notes = check([resting], JOINTS, ("revolute", "revolute"))
        assert "joint-at-rest" in [note.code for note in notes]


def test_noise_of_a_coarse_velocity_at_rest_is_not_motion():
    """The velocity has steps of 0.066 rad/s, no word for 0, and noise of 1.5 steps; its position is constant for 9 s.

    The integral of the velocities of a joint at rest then changes by 0.1 rad.
    """
    t = 0.001 * np.arange(18000)
    q = np.maximum(np.sin(t), np.sin(9.0))
    rows = t > 9.0
    q[rows] = q[rows][0]
    noise = np.random.default_rng(0).standard_normal(len(t))
    qd = 0.066 * np.round((np.gradient(q, t) + 0.1 * noise) / 0.066) - 0.011
    tau = np.column_stack([np.sin(t) + 0.01 * noise, np.cos(t) + 0.01 * noise])
    log = Trajectory(t, np.column_stack([q, q]), np.column_stack([qd, qd]), tau, name="x")
    check([log], JOINTS, ("revolute", "revolute"))  # raises LogError if the position is reported as frozen


def test_what_never_changes_in_any_trajectory_is_said():
    resting = changed(q={1: 0.5}, qd={1: 0.0}, tau={1: 0.0})
    notes = check([resting], JOINTS, ("revolute", "revolute"))
    assert [(x.severity, x.code, x.where, x.message) for x in notes] == [
        (
            "warning", "constant-torque", "trajectory x, joint 'b'",
            "tau is always 0: right for a joint without a motor only",
        ),
        (
            "info", "joint-at-rest", "trajectory x, joint 'b'",
            "does not move: the logs do not excite its dynamics",
        ),
    ]  # fmt: skip
    assert check([resting, swing()], JOINTS, ("revolute", "revolute")) == []


def test_noise_of_a_joint_at_rest_is_no_motion():
    """Noise at a joint at rest is not reported as a contradiction of velocities and derivatives of positions.

    The only remark is that the joint is at rest.
    """
    rng, length = np.random.default_rng(0), len(swing().t)
    noisy = changed(q={1: 0.5 + 1e-6 * rng.normal(size=length)}, qd={1: 1e-4 * rng.normal(size=length)})
    notes = check([noisy], JOINTS, ("revolute", "revolute"))
    assert [(x.severity, x.code, x.where) for x in notes] == [
        ("info", "joint-at-rest", "trajectory x, joint 'b'")
    ]


@pytest.mark.parametrize(
    ("trajectory", "got", "line"),
    [
        (scaled(swing(), qd=-1.0), "its sense is opposite", "velocity: differentiated"),
        (
            Trajectory(swing().t, swing().q, swing().qd[:, ::-1], swing().tau, "x"),
            "that of joint 'b' is",
            "joints: {a: {columns: {qd: qd_b}}, b: {columns: {qd: qd_a}}}",
        ),
        (
            Trajectory(swing().t, swing().qd, swing().q, swing().tau, "x"),
            "q is the derivative of qd",
            "joints: {a: {columns: {q: qd_a, qd: q_a}}, b: {columns: {q: qd_b, qd: q_b}}}",
        ),
    ],
)
def test_a_velocity_that_other_columns_explain_is_an_error_with_their_line(trajectory, got, line):
    with pytest.raises(LogError) as caught:
        check([trajectory] * 3, JOINTS, ("revolute", "revolute"))
    assert f"; {got} (and in 2 more trajectories), expected dq/dt" in str(caught.value)
    assert f"; write '{line}' under 'logs' in the robot's YAML; --accept velocity-is" in str(caught.value)


def test_exchanged_velocities_of_synchronous_joints_are_found_by_their_magnitude():
    """Each joint gets the velocity of the right magnitude if the velocities of all joints are proportional."""
    t, distances = swing().t, np.array([1.0, 2.0, -3.0])
    q, qd = (np.outer(x, distances) for x in (np.sin(np.pi * t), np.pi * np.cos(np.pi * t)))
    exchanged = Trajectory(t, q, qd[:, [1, 0, 2]], np.sin(np.outer(t, [2.0, 3.0, 5.0])), "x")
    line = "joints: {a: {columns: {qd: qd_b}}, b: {columns: {qd: qd_a}}}"
    with pytest.raises(LogError, match=re.escape(f"write '{line}' under 'logs'")):
        check([exchanged], "abc", ("revolute",) * 3)


def with_gap() -> Trajectory:
    whole = swing(jitter=0.4)
    t = whole.t + np.where(np.arange(200) >= 120, 0.5, 0.0)
    return Trajectory(t, whole.q, whole.qd, whole.tau, "gap")


def test_gaps_split_and_are_said():
    pieces = split_at_gaps(with_gap())
    assert [len(x.t) for x in pieces] == [120, 80]
    notes = check([with_gap()], JOINTS, ("revolute", "revolute"))
    assert [(x.code, x.message[:14]) for x in notes] == [("gap", "1 gap in time,")]


def test_no_window_crosses_a_gap():
    pieces = Preprocessing(cutoff=0.0).pieces([with_gap()], shortest=5)
    windows = cut_windows(pieces, 5, measured=False)
    assert len(windows) == (120 - 4) + (80 - 4)
    assert windows.dt.max() < 0.02


def test_a_trajectory_without_a_whole_window_is_refused():
    with pytest.raises(LogError) as caught:
        Preprocessing(cutoff=0.0).pieces([with_gap()], shortest=121)
    assert str(caught.value) == (
        "trajectory gap: got 120 samples without a gap, expected at least 121, one window; "
        "record longer or train with a shorter window"
    )


@pytest.mark.parametrize(("rate", "first"), [(40.0, 1.03), (250.0, 0.12)])
def test_logs_may_begin_at_any_time(rate, first):
    t = first + np.arange(41) / rate
    line = np.stack([t, 2 * t], axis=1)
    regular = regular_times(t, 100.0)
    assert regular[-1] > t[-1]  # the last regular time is later than the log's end by rounding
    np.testing.assert_allclose(resampled(t, line, regular, rate)[:, 1], 2 * regular, atol=1e-12)


def test_the_filter_has_no_delay_and_takes_out_noise():
    clean = swing(samples=1000, jitter=0.3)
    random = np.random.default_rng(1)
    noise = (0.1 * random.standard_normal(clean.q.shape) for _ in range(3))
    noisy = Trajectory(clean.t, *(x + e for x, e in zip((clean.q, clean.qd, clean.tau), noise, strict=True)))
    smooth = low_pass(noisy, 5.0)
    np.testing.assert_array_equal(smooth.t, clean.t)
    middle = slice(50, -50)  # the ends are omitted: there the filter has neighbours on one side only
    for quantity in ("q", "qd", "tau"):
        error = getattr(smooth, quantity)[middle] - getattr(clean, quantity)[middle]
        assert (
            np.sqrt(np.mean(error**2)) < 0.045
        )  # the expected error is 0.1 sqrt(2 cutoff / rate) = 0.032; a delay of 1 ms would add 0.009
    np.testing.assert_allclose(low_pass(clean, 8.0).q[middle], clean.q[middle], atol=2e-5)


def test_the_filter_needs_more_than_two_samples_per_period():
    with pytest.raises(LogError) as caught:
        low_pass(swing(dt=0.1), 8.0)
    assert str(caught.value) == (
        "trajectory swing: got a filter of 8 Hz on samples at 10 Hz, expected below 5 Hz; "
        "lower or drop the filter"
    )


def test_only_dense_logs_are_filtered_unasked():
    automatic, filtered = Preprocessing(), Preprocessing(cutoff=8.0)
    assert automatic.resolved([100.0]).cutoff == 8.0
    assert automatic.resolved([100.0, 20.0]).cutoff is None
    assert filtered.resolved([100.1]).decimation == 4
    assert Preprocessing(cutoff=0.0).resolved([1000.0]).decimation == 1
    # rates that differ by the error of a logger's clock have the same decimation
    for nominal in (50.0, 60.0, 100.0, 120.0, 500.0):
        rates = nominal * np.array([0.999, 1.0, 1.001])
        assert len({filtered.resolved([rate]).decimation for rate in rates}) == 1
        assert len({automatic.resolved([rate]).cutoff for rate in rates}) == 1
        assert all(map(shows_accelerations, rates))


def test_the_rate_ignores_gaps():
    assert with_gap().sample_rate == pytest.approx(100, rel=0.05)


@pytest.mark.parametrize("every", [1, 3])
def test_windows_hold_the_log_own_times_and_inputs(every):
    trajectory = swing(jitter=0.4)
    windows = cut_windows([trajectory], 4, 2, every, measured=False)
    start = 2 * 7  # windows start at every second sample: the eighth at sample 14
    rows = start + every * np.arange(4)
    np.testing.assert_array_equal(windows.q[7], trajectory.q[rows])
    np.testing.assert_array_equal(windows.qd[7], trajectory.qd[rows])
    np.testing.assert_allclose(windows.dt[7], np.diff(trajectory.t[rows]), rtol=1e-12)
    impulse = np.diff(trajectory.t)[:, None] * trajectory.tau[:-1]
    held = [impulse[a:b].sum(axis=0) for a, b in pairwise(rows)] / np.diff(trajectory.t[rows])[:, None]
    np.testing.assert_allclose(windows.tau[7], held, rtol=1e-12)


def test_a_measured_input_is_held_at_the_mean_of_both_ends():
    trajectory = swing()
    windows = cut_windows([trajectory], 3, measured=True)
    expected = (trajectory.tau[:-1] + trajectory.tau[1:]) / 2
    torch.testing.assert_close(windows.tau[:, 0], torch.from_numpy(expected[:-1]))


def test_the_split_is_by_trajectory():
    trajectories = [swing(str(k), seed=k) for k in range(8)]
    split = split_validation(trajectories, 0.25, seed=3)
    training, validation = {x.name for x in split.training}, {x.name for x in split.validation}
    assert len(validation) == 2
    assert training.isdisjoint(validation)
    assert training | validation == {str(k) for k in range(8)}
    assert split.validation == split_validation(trajectories, 0.25, seed=3).validation
    assert any(split_validation(trajectories, 0.25, seed=k).validation != split.validation for k in range(3))


def test_a_gap_does_not_leak_into_validation():
    trajectories = [with_gap(), swing("other")]
    split = split_validation(trajectories, 0.5, seed=0)
    names = [
        {x.name for x in Preprocessing(cutoff=0.0).pieces(part, shortest=5)}
        for part in (split.training, split.validation)
    ]
    assert names[0].isdisjoint(names[1])


def test_a_single_trajectory_is_split_in_time():
    split = split_validation([swing()], 0.25, seed=0)
    (training,), (validation,) = split.training, split.validation
    assert training.t[-1] < validation.t[0]
    assert len(validation.t) == pytest.approx(50, abs=1)
    assert split.note.severity == "info"
    assert split.note.message.startswith("only one trajectory: training on its first 1.4")


def test_real_logs_are_read(shared):
    joints = [f"panda_joint{k}" for k in range(1, 8)]
    (trajectory,) = read_logs([shared / "logs" / "panda"], joints)
    assert trajectory.q.shape == (20544, 7)
    notes = check([trajectory], joints, ("revolute",) * 7)
    assert [x.code for x in notes] == ["gap"]
    assert len(Preprocessing(cutoff=8.0).pieces([trajectory], shortest=5)) == 5


def test_a_models_logs_have_the_urdfs_names(tmp_path):
    text = (Path(__file__).parents[1] / "robots" / "two_link.urdf").read_text()
    urdf = tmp_path / "named.urdf"
    urdf.write_text(text.replace('"joint1"', '"Arm/1 (left)"').replace('"joint2"', '"class"'))
    arm = load_arm(urdf)
    model = build(arm)
    assert model.joint_names == ("Arm/1 (left)", "class")
    t = np.arange(5) / 100
    log = Trajectory(t, *(np.full((5, 2), k) for k in (1.0, 2.0, 3.0)), name="one")
    path = write_logs(tmp_path / "log.csv", [log], arm)
    for owner in (arm, model):
        assert np.array_equal(read_logs(path, owner)[0].tau, log.tau)


def test_what_is_said_of_many_recordings_is_said_once():
    slow = swing("a", dt=0.05)
    (note,) = check([slow, replace(slow, name="b", tau=slow.tau + 1)], JOINTS, ("revolute", "revolute"))
    assert (note.code, note.where) == ("low-rate", "trajectory a")
    assert note.message.startswith("20 Hz: ") and note.message.endswith(" (and in 1 more trajectory)")


def test_reversed_columns_are_cut_into_windows():
    t = 0.02 * np.arange(120)
    q = np.sin(t[:, None] * [1.0, 1.7])[:, ::-1]
    windows = cut_windows([Trajectory(t, q, q, q, "x")], 5, measured=False)
    assert windows.q.shape == (116, 5, 2)


@pytest.mark.parametrize("origin", [0.0, 1.7e9])
def test_files_that_continue_each_other_are_one_recording(tmp_path, origin):
    """Five files of one second each, with times of one clock, are joined; two other recordings remain separate."""
    t = np.arange(500) / 100
    whole = Trajectory(t, np.sin(t)[:, None], np.cos(t)[:, None], t[:, None], "whole")
    for k in range(5):
        piece = whole[100 * k : 100 * k + 100]
        values = np.column_stack([piece.t, piece.q, piece.qd, piece.tau]).tolist()
        rows = [f"{origin + x:.4f},{q!r},{qd!r},{tau!r}\n" for x, q, qd, tau in values]
        csv(tmp_path / f"{4 - k}.csv", HEADER + "".join(rows))
    csv(tmp_path / "later.csv", HEADER + "".join(f"{origin + 6 + k / 100},0,0,0\n" for k in range(50)))
    csv(tmp_path / "elsewhere.csv", HEADER + "".join(f"{origin + 5 + k / 100},9,0,0\n" for k in range(50)))
    joined, *others = read_logs(tmp_path, ("a",))
    assert [len(x) for x in (joined, *others)] == [500, 50, 50]
    np.testing.assert_allclose(joined.t - joined.t[0], t, atol=1e-6)
    np.testing.assert_array_equal(joined.q, whole.q)
    assert "the files up to 0.csv continue it" in joined.remarks[0]
