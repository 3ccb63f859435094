"""A log that is read with the mapping suggested from its column names has the values that were written, in SI units."""

import csv
import subprocess
import sys

import numpy as np
import pyarrow as pa
import pyarrow.parquet
import pytest
import scipy.io
from typer.testing import CliRunner

from spelgen.arm.configured_arm import load_arm
from spelgen.cli.main import app
from spelgen.errors import LogError
from spelgen.logs.arm_mapping import log_source
from spelgen.logs.formats import log_files
from spelgen.logs.read import read_logs
from spelgen.logs.suggest import suggest_mapping

T = np.arange(200) * 0.008
Q = np.stack([0.8 * np.sin(3 * T), 0.7 * np.cos(2 * T), 0.1 + 0.02 * np.sin(T), np.sin(T)], axis=1)
QD = np.gradient(Q, T, axis=0)
TAU = np.stack([np.cos(3 * T), T, np.full(200, 20.0) - T, 0.1 * T], axis=1)


@pytest.fixture(scope="module")
def scara(robots):
    return load_arm(robots / "scara.urdf")


def suggested(path, arm):
    """Return the log that is read with the suggested mapping, and the text of the mapping."""
    found = suggest_mapping(path, [x.name for x in arm.chain.coordinates])
    assert not found.missing
    path.with_suffix(".yaml").write_text(found.text)
    (read,) = read_logs(path, arm, path.with_suffix(".yaml"))
    return read, found.text


def written(path, head, rows):
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([head, *rows])
    return path


def require_same(found, rtol=1e-9, qd=QD):
    for values, expected in ((found.q, Q), (found.qd, qd), (found.tau, TAU)):
        np.testing.assert_allclose(values, expected, rtol=rtol, atol=1e-9)
    # some logs have times of about 1.7e9 s, where doubles have a spacing of 2.4e-7 s; the tolerance is four times this
    np.testing.assert_allclose(found.t - found.t[0], T, atol=1e-6)


def test_lists_of_joint_states_with_times_in_milliseconds(scara, tmp_path):
    columns = {"time_ms": 1000 * T, "position": list(Q), "velocity": list(QD), "effort": list(TAU)}
    pa.parquet.write_table(pa.table(columns), tmp_path / "log.parquet")
    found, text = suggested(tmp_path / "log.parquet", scara)
    require_same(found)
    assert 'units: {"t": "ms"}' in text


def test_numbered_columns_with_set_points_and_without_velocities(scara, tmp_path):
    head = ["timestamp", *(f"target_q_{k}" for k in range(4)), *(f"actual_q_{k}" for k in range(4))]
    head += [f"actual_current_{k}" for k in range(4)]
    rows = [[1.7e9 + t, *(0 * q), *q, *tau] for t, q, tau in zip(T, Q, TAU, strict=True)]
    found, text = suggested(written(tmp_path / "log.csv", head, rows), scara)
    require_same(found, rtol=1e-4, qd=found.qd)
    assert "velocity: differentiated" in text
    assert "check it, and the order of the joints" in text
    assert 'units: {"t": "s", "tau": "A"}' in text
    assert text.count("gain: 1.0 # Nm per A at the joint, the gear included: write its value") == 4


@pytest.mark.parametrize("derivative", ["D_Theta_{}", "theta_dot_{}", "dtheta{}"])
def test_derivatives_of_positions_are_velocities(scara, tmp_path, derivative):
    """Columns named as derivatives of positions, as in public simulations and MATLAB, are read as velocities.

    Columns of accelerations are not read.
    """
    names = ["Theta_{}", derivative, "Torque_{}", "DD_Theta_{}", "theta_ddot_{}"]
    head = ["Time", *(name.format(k) for name in names for k in range(4))]
    rows = np.column_stack([T, Q, QD, TAU, -Q, -Q])
    found, text = suggested(written(tmp_path / "log.csv", head, rows), scara)
    require_same(found)
    assert "differentiated" not in text


@pytest.mark.parametrize(
    ("encoding", "words"),
    [
        ("cp932", ("時刻[ms]", "関節{}位置", "関節{}速度", "関節{}トルク")),
        ("gb18030", ("时间[ms]", "关节{}位置", "关节{}速度", "关节{}力矩")),
        ("cp949", ("시간[ms]", "관절{} 위치", "관절{} 속도", "관절{} 토크")),
        ("cp1251", ("время [ms]", "положение {}", "скорость {}", "момент {}")),
        ("latin-1", ("tiempo [ms]", "posición {}", "velocidad {}", "par {}")),
    ],
)
def test_names_of_columns_may_be_in_any_character_set_of_spreadsheets(scara, tmp_path, encoding, words):
    clock, *names = words
    head = [clock, *(name.format(k) for name in names for k in range(1, 5))]
    path = written(tmp_path / "log.csv", head, np.column_stack([1000 * T, Q, QD, TAU]))
    path.write_bytes(path.read_text(encoding="utf-8").encode(encoding))
    require_same(suggested(path, scara)[0])


@pytest.mark.parametrize("form", ["columns", "matrices"])
@pytest.mark.parametrize(("state", "torque"), [("x", "u"), ("state", "tau"), ("obs", "u")])
def test_a_state_of_positions_and_velocities_is_recognised_by_its_values(
    scara, tmp_path, form, state, torque
):
    """A suggested mapping assigns the first half of a state [q; qd] to positions and the last half to velocities.

    The column names (x0 to x7) do not distinguish both halves, so the values determine the assignment.
    """
    if form == "matrices":
        path = tmp_path / "log.npz"
        np.savez(path, **{"t": T, state: np.column_stack([Q, QD]), torque: TAU})
    else:
        head = ["t", *(f"{state}{k}" for k in range(8)), *(f"{torque}{k}" for k in range(4))]
        path = written(tmp_path / "log.csv", head, np.column_stack([T, Q, QD, TAU]))
    require_same(suggested(path, scara)[0])


@pytest.mark.parametrize("form", ["two matrices", "one matrix"])
def test_matrices_of_two_arms_are_refused(scara, tmp_path, form):
    arrays = {"q": np.column_stack([Q, -Q]), "tau": np.column_stack([TAU, TAU])}
    if form == "two matrices":
        arrays = {"left_q": Q, "left_tau": TAU, "right_q": -Q, "right_tau": TAU}
    np.savez(tmp_path / "log.npz", t=T, **arrays)
    with pytest.raises(LogError, match=r"got (positions of 2 arms|8 columns of positions that change)"):
        suggest_mapping(tmp_path / "log.npz", scara.chain.joint_names)


def test_units_and_clocks_in_the_middle_of_names(scara, tmp_path):
    """A unit in a column name may precede the joint number (load_0.1%_0); times may be two columns, one of nanoseconds.

    Columns of disturbance torques (DistTrq) are not suggested as joint torques.
    """
    head = ["stamp_seconds", "stamp_nanos", *(f"q{k}/°" for k in range(4))]
    head += [f"{name}_{k}" for name in ("speed", "load_0.1%", "DistTrq") for k in range(4)]
    whole = np.floor(1.7e9 + T)
    rows = np.column_stack([whole, 1e9 * (1.7e9 + T - whole), np.degrees(Q), QD, 10 * TAU, 7 * TAU])
    path = written(tmp_path / "log.csv", head, [[int(x) for x in row[:2]] + row[2:].tolist() for row in rows])
    text = suggest_mapping(path, scara.chain.joint_names).text
    assert '"tau": "0.1 percent"' in text
    assert '"q": "deg"' in text
    assert "stamp_seconds + stamp_nanos" in text


def test_the_more_regular_of_two_clocks_and_ticks_of_100_ns(scara, tmp_path):
    late = T + 0.004 * np.random.default_rng(0).random(len(T))
    ticks = [134_000_000_000_000_000 + round(1e7 * t) for t in T]
    head = ["host_time", "robot_time", *(f"{x}{k}" for x in ("q", "qd", "tau") for k in range(4))]
    rows = np.column_stack([Q, QD, TAU]).tolist()
    path = written(tmp_path / "log.csv", head, [[a, b, *x] for a, b, x in zip(late, T, rows, strict=True)])
    require_same(suggested(path, scara)[0])
    path = written(
        tmp_path / "log.csv", ["time", *head[2:]], [[b, *x] for b, x in zip(ticks, rows, strict=True)]
    )
    found, text = suggested(path, scara)
    require_same(found)
    assert '"0.1 us"' in text


def test_a_column_that_counts_the_rows_is_not_the_clock_if_there_is_another(scara, tmp_path):
    head = ["time", "robot_timestamp", *(f"{x}{k}" for x in ("q", "qd", "tau") for k in range(4))]
    rows = [
        [k + 1, 1550 + t, *x] for k, (t, x) in enumerate(zip(T, np.column_stack([Q, QD, TAU]), strict=True))
    ]
    found, text = suggested(written(tmp_path / "log.csv", head, rows), scara)
    require_same(found)
    assert "# not used for t: time" in text


def test_times_that_fall_are_called_so(scara, tmp_path):
    """If times decrease from row to row, such as remaining times, the error states this and advises `sample_rate`.

    If times decrease at a few rows only, a recording starts at each of them, and another error advises a column with
    the number of the recording. This advice would be wrong here: each row would be a recording.
    """
    head = ["t", *(f"{x}_{joint}" for x in ("q", "qd", "tau") for joint in scara.chain.joint_names)]
    path = written(tmp_path / "log.csv", head, np.column_stack([T[::-1], Q, QD, TAU]))
    with pytest.raises(LogError, match=r"got times that fall from .*write 'sample_rate: HZ'"):
        read_logs(path, scara)
    # Rows in reverse order are sorted, also without velocities.
    path = written(path, head, np.column_stack([T, Q, QD, TAU])[::-1])
    for mapping in ({}, {"velocity": "differentiated"}):
        np.testing.assert_array_equal(read_logs(path, scara, mapping)[0].q, Q)


@pytest.mark.parametrize("file", ["struct.mat", "flat.mat", "dict.npy"])
def test_files_of_matlab_and_pickles_are_converted_by_the_printed_command(scara, tmp_path, file):
    """The error about a MATLAB or pickled file prints a command that converts it, also from a struct or dict.

    It warns of pickles, which may execute code. For files of MATLAB 7.3, which are HDF5, it advises h5py.
    """
    arrays = {"t": T, "q": Q, "qd": QD, "tau": TAU}
    if file == "dict.npy":
        np.save(tmp_path / file, arrays, allow_pickle=True)
    else:
        scipy.io.savemat(tmp_path / file, {"log": arrays, "robot": "x"} if file == "struct.mat" else arrays)
    (error,) = log_files(tmp_path / file)[1]
    command, _, warning = str(error.do).removeprefix("convert it: ").partition('" (')
    assert ("pickles" in warning) == (file == "dict.npy")
    subprocess.run([sys.executable, "-c", command.split('"')[1]], check=True)
    suffix = ".npz" if file == "dict.npy" else ".json"
    require_same(suggested((tmp_path / file).with_suffix(suffix), scara)[0])
    (tmp_path / "new.mat").write_bytes(b"MATLAB 7.3 MAT-file".ljust(600))
    (error,) = log_files(tmp_path / "new.mat")[1]
    assert "h5py" in str(error.do)


def test_rows_without_times_get_a_rate_to_write(scara, tmp_path):
    head = [f"{x}{k}" for x in ("q", "tau") for k in range(4)]
    path = written(tmp_path / "log.csv", head, np.column_stack([Q, TAU]))
    text = suggest_mapping(path, scara.chain.joint_names).text
    assert "sample_rate: # [Hz] of the rows" in text
    (tmp_path / "map.yaml").write_text(text)
    with pytest.raises(LogError, match="or 'sample_rate: HZ' if there is none"):
        read_logs(path, scara, tmp_path / "map.yaml")
    (tmp_path / "map.yaml").write_text(text.replace("sample_rate:", "sample_rate: 125"))
    (found,) = read_logs(path, scara, tmp_path / "map.yaml")
    np.testing.assert_allclose(found.t, T, atol=1e-12)
    np.testing.assert_array_equal(found.tau, TAU)


def test_a_file_of_torques_only_is_to_be_joined_with_the_positions(scara, tmp_path):
    head = ["t", *(f"- {name}_effort" for name in scara.chain.joint_names)]
    path = written(tmp_path / "effort.csv", head, np.column_stack([T, TAU]))
    with pytest.raises(
        LogError, match=r"no positions .*join files with a signal each .*merge\(pandas.read_csv"
    ):
        suggest_mapping(path, scara.chain.joint_names)
    # the error must not advise to rename the columns of effort to q
    with pytest.raises(LogError, match="or write their names under 'logs'"):
        read_logs(path, scara)
    # files without times cannot be merged by them: their rows are joined
    without_times = written(tmp_path / "untimed.csv", head[1:], TAU)
    with pytest.raises(LogError, match=r"no positions .*join\(pandas.read_csv\(OTHER\), lsuffix"):
        suggest_mapping(without_times, scara.chain.joint_names)


def test_actual_and_target_positions_of_one_of_four_legs_are_found(tmp_path):
    legs = ("FR", "FL", "RR", "RL")
    head = [
        "timestamp",
        *(f"{leg}_{k}_{x}" for leg in legs for k in range(3) for x in ("target", "actual", "error")),
    ]
    values = np.random.default_rng(0).normal(size=(len(T), 36)).cumsum(axis=0)
    path = written(tmp_path / "legs.csv", head, np.column_stack([T, values]))
    for leg in legs:
        found = suggest_mapping(path, [f"{leg}_{x}_joint" for x in ("hip", "thigh", "calf")], commands=True)
        for k, part in enumerate(("hip", "thigh", "calf")):
            columns = f'columns: {{"q": "{leg}_{k}_actual", "u": "{leg}_{k}_target"}}'
            assert f'"{leg}_{part}_joint":\n    {columns}' in found.text


def test_a_row_per_joint_is_to_be_pivoted(scara, tmp_path):
    rows = [[t, joint, 0.0, 0.0] for t in T for joint in scara.chain.joint_names]
    path = written(tmp_path / "long.csv", ["time", "name", "position", "effort"], rows)
    with pytest.raises(
        LogError, match=r"joints in the column 'name', expected all joints in each row; .*columns='name'\)"
    ):
        suggest_mapping(path, scara.chain.joint_names)


PUBLIC = {
    "libfranka": ("time", "q[{}]", "dq[{}]", "tau_J[{}]", "O_T_EE[{}] q_d[{}] dq_d[{}] tau_J_d[{}] dtau_J[{}] "
                  "tau_ext_hat_filtered[{}]"),
    "RTDE": ("timestamp", "actual_q_{}", "actual_qd_{}", "actual_moment_{}", "target_q_{} target_moment_{} "
             "actual_current_{} actual_TCP_speed_{} actual_TCP_force_{}"),
    "set and actual": ("t", "q_act_{}", "dq_act_{}", "trq_{}", "q_set_{} I_act_{} friction_trq_{} gravity_trq_{}"),
    "Doosan": ("time", "actual_joint_position_{}", "actual_joint_velocity_{}", "actual_joint_torque_{}",
               "raw_joint_torque_{} actual_motor_torque_{}"),
    "FRI": ("sec nsec", "measured_position_{}", "measured_speed_{}", "measured_torque_{}", "ipo_position_{} "
            "commanded_position_{} commanded_torque_{} external_torque_{}"),
    "Flexiv": ("timestamp", "q_{}", "dq_{}", "tau_{}", "theta_{} dtheta_{} tau_des_{} tau_dot_{} tau_interact_{}"),
    "Dobot": ("time_stamp", "q_actual_{}", "qd_actual_{}", "m_actual_{}", "q_target_{} m_target_{} i_actual_{}"),
    "Aubo": ("time", "status{}.jointPosJ", "status{}.jointSpeedMoto", "status{}.jointTorque", "status{}.jointCurVol "
             "status{}.jointTargetPosJ status{}.jointCurrentI"),
    "Sunrise": ("sec nsec", "axisQMsr_LBR_14_R820_1[{}]", "axisVelMsr_LBR_14_R820_1[{}]",
                "axisTauMsr_LBR_14_R820_1[{}]", "axisQCmd_LBR_14_R820_1[{}] axisTauExtMsr_LBR_14_R820_1[{}]"),
    "FRI of Sunrise": ("Timestamp NanoSeconds", "MeasuredJointPosition{}", "MeasuredJointSpeed{}", "MeasuredTorque{}",
                       "CommandedJointPosition{} ExternalTorque{}"),
    "EGM": ("header.tm", "feedBack.joints.joints[{}]", "feedBack.speed[{}]", "measured.torque[{}]",
            "planned.joints.joints[{}]"),
    "Fanuc": ("Tick", "J{} Current Angle", "J{} Current Speed", "J{} Torque", "J{} Disturbance Torque"),
    "Kortex": ("ts", "actuators[{}].position", "actuators[{}].velocity", "actuators[{}].torque", ""
               "actuators[{}].current actuators[{}].temperature_motor"),
}  # fmt: skip


@pytest.mark.parametrize("source", PUBLIC)
def test_of_several_signals_of_a_quantity_the_measured_one_of_the_joints_is_taken(scara, tmp_path, source):
    """If a log has several signals of a quantity, the suggested mapping selects the measured signal of the joints.

    The other signals are set points, tool forces and estimates, with similar names. The column names are from public
    recordings.
    """
    clock, *measured, others = PUBLIC[source]
    names = [*measured, *others.split()]
    head = [*clock.split(), *(name.format(k) for name in names for k in range(4))]
    times = np.stack([np.floor(T + 99), np.round(T % 1 * 1e9)] if " " in clock else [T], axis=1)
    rest = np.random.default_rng(1).normal(size=(len(T), 4 * (len(names) - 3)))
    rows = np.column_stack([times, Q, QD, TAU, rest])
    require_same(suggested(written(tmp_path / "log.csv", head, rows), scara)[0])


def test_joints_named_by_words_of_other_signals(scara, tmp_path):
    text = (scara.robot.path).read_text()
    for k, name in enumerate(("tool_joint", "set_joint", "target_slide", "ee")):
        text = text.replace(f'"joint{k + 1}"', f'"{name}"')
    (tmp_path / "arm.urdf").write_text(text)
    arm = load_arm(tmp_path / "arm.urdf")
    head = ["t", *(f"{x}_{name}" for x in ("q", "qd", "tau") for name in arm.chain.joint_names)]
    require_same(suggested(written(tmp_path / "log.csv", head, np.column_stack([T, Q, QD, TAU])), arm)[0])


def test_columns_of_pandas_with_a_date_as_index(scara, tmp_path):
    names = [x.name for x in scara.chain.coordinates]
    log = {
        f"('{x}', '{name}')": values[:, k]
        for x, values in (("position", Q), ("velocity", QD), ("effort", TAU))
        for k, name in enumerate(names)
    }
    dates = pa.array((1.7e18 + np.round(T * 1e9)).astype(np.int64)).cast(pa.timestamp("ns"))
    pa.parquet.write_table(pa.table(log | {"__index_level_0__": dates}), tmp_path / "log.parquet")
    require_same(suggested(tmp_path / "log.parquet", scara)[0])


def test_names_of_joints_count_before_numbers(scara, tmp_path):
    names = [x.name for x in scara.chain.coordinates]
    order = [3, 1, 0, 2]
    head = ["t", *(f"/{what}/{names[k]}/x0" for what in ("position", "velocity", "torque") for k in order)]
    rows = [[t, *q[order], *qd[order], *tau[order]] for t, q, qd, tau in zip(T, Q, QD, TAU, strict=True)]
    require_same(suggested(written(tmp_path / "log.csv", head, rows), scara)[0])


def test_columns_of_another_arm_are_listed(scara, tmp_path):
    names = [x.name for x in scara.chain.coordinates]
    sides = [
        f"{side}_{x}_{name}" for side in ("left", "right") for x in ("pos", "vel", "tau") for name in names
    ]
    rows = np.column_stack([T, 0 * Q, 0 * QD, 0 * TAU, Q, QD, TAU])
    found, text = suggested(written(tmp_path / "log.csv", ["t", *sides], rows), scara)
    require_same(found)
    assert f"# not used for q: left_pos_{names[0]} ... left_pos_{names[-1]}\n" in text


@pytest.mark.parametrize(("unit", "name"), [("%", "percent"), ("‰", "permille"), ("A", "A")])
def test_parts_of_a_torque_get_a_gain_to_write(scara, tmp_path, unit, name):
    head = [
        "t",
        *(f"{x}_{k}{end}" for x, end in (("q", ""), ("qd", ""), ("tau", f" [{unit}]")) for k in range(4)),
    ]
    found, text = suggested(written(tmp_path / "log.csv", head, np.column_stack([T, Q, QD, TAU])), scara)
    require_same(found)
    assert f'"tau": "{name}"' in text and text.count(f"gain: 1.0 # Nm per {name}") == 4


@pytest.mark.parametrize(
    "words",
    [
        ("Zeit", "Winkel", "Geschwindigkeit", "Drehmoment"),
        ("t", "θ", "ω", "τ"),
        ("temps", "position", "vitesse", "couple"),
        ("时间", "位置", "速度", "力矩"),
        ("time", "qpos", "qvel", "qfrc_actuator"),
        ("time", "pos", "vel", "eff"),
        ("时间", "关节实际位置", "关节实际速度", "关节电流"),
    ],
)
def test_words_of_other_languages(scara, tmp_path, words):
    head = [words[0], *(f"{word} {k}" for word in words[1:] for k in range(4))]
    rows = [[t, *q, *qd, *tau] for t, q, qd, tau in zip(T, Q, QD, TAU, strict=True)]
    require_same(suggested(written(tmp_path / "log.csv", head, rows), scara)[0])


@pytest.mark.parametrize("setpoint", ["position consigne {}", "关节{}目标位置", "Soll Winkel {}"])
def test_set_points_in_other_languages_are_not_measurements(scara, tmp_path, setpoint):
    measured = setpoint.replace(" consigne", " mesure").replace("目标", "实际").replace("Soll", "Ist")
    head = ["t", *(form.format(k) for form in (measured, "speed{}", "torque{}", setpoint) for k in range(4))]
    rows = np.column_stack([T, Q, QD, TAU, Q + 0.01])
    require_same(suggested(written(tmp_path / "log.csv", head, rows), scara)[0])


@pytest.mark.parametrize(
    "form", ["{0}_{1}_{2}", "{0}[{1}]_{2}", "{0} {2} [{1}]", "{0}_{1}[{2}]", "J{2}_{0}_{1}"]
)
def test_units_are_found_anywhere_in_a_name(scara, tmp_path, form):
    (tmp_path / "arm.urdf").write_text(
        scara.robot.path.read_text().replace('type="prismatic"', 'type="revolute"')
    )
    arm = load_arm(tmp_path / "arm.urdf")
    signals = (
        ("angle", "deg", Q * 180 / np.pi),
        ("speed", "rpm", QD * 30 / np.pi),
        ("torque", "mNm", TAU * 1e3),
    )
    head = ["t", *(form.format(word, unit, k) for word, unit, _ in signals for k in range(4))]
    rows = np.column_stack([T, *(values for *_, values in signals)])
    require_same(suggested(written(tmp_path / "log.csv", head, rows), arm)[0])


@pytest.mark.parametrize(
    ("unit", "factor"),
    [("kgf.cm", 0.0980665), ("kg·cm", 0.0980665), ("N cm", 0.01), ("N·m", 1.0), ("mN-m", 1e-3)],
)
def test_units_of_torques_are_products(scara, tmp_path, unit, factor):
    """Units of torques are read with a dot, a hyphen, a space or a centred dot between force and length."""
    (tmp_path / "arm.urdf").write_text(
        scara.robot.path.read_text().replace('type="prismatic"', 'type="revolute"')
    )
    head = [
        "t",
        *(f"{word}{k}" for word in ("q", "qd") for k in range(4)),
        *(f"tau{k}({unit})" for k in range(4)),
    ]
    path = written(tmp_path / "log.csv", head, np.column_stack([T, Q, QD, TAU / factor]))
    require_same(suggested(path, load_arm(tmp_path / "arm.urdf"))[0])


def test_a_unit_that_is_not_known_is_named_in_the_draft(scara, tmp_path):
    head = [
        "t",
        *(f"{word}{k}" for word in ("q", "qd") for k in range(4)),
        *(f"tau{k} (dyn cm)" for k in range(4)),
    ]
    path = written(tmp_path / "log.csv", head, np.column_stack([T, Q, QD, TAU]))
    assert "# not a known unit of tau: dyncm" in suggested(path, scara)[1]


@pytest.mark.parametrize(("scale", "unit"), [(1.0, "s"), (1e3, "ms")])
def test_times_without_a_known_name_are_found_by_their_steps(scara, tmp_path, scale, unit):
    """A column that rises by regular steps is the clock, and a counter of rows is not."""
    head = ["No", "X_Value", *(f"{word}{k}" for word in ("q", "qd", "tau") for k in range(4))]
    rows = [[k, *row] for k, row in enumerate(np.column_stack([T * scale, Q, QD, TAU]).tolist())]
    log, text = suggested(written(tmp_path / "log.csv", head, rows), scara)
    require_same(log)
    assert f'units: {{"t": "{unit}"}}' in text


@pytest.mark.parametrize(("first", "second"), [("left_", "right_"), ("robot1/", "robot2/")])
@pytest.mark.parametrize("form", ["{}{}_{}", "{}{}{}"])
def test_columns_of_two_arms_are_refused(scara, tmp_path, first, second, form):
    """If a log has columns of two arms that both fit the URDF, no mapping is drafted; the error names both arms."""
    joints = [x.name for x in scara.chain.coordinates] if "_" in form else range(4)
    head = [
        "t",
        *(
            form.format(arm, word, k)
            for arm in (first, second)
            for word in ("q", "qd", "tau")
            for k in joints
        ),
    ]
    path = written(tmp_path / "log.csv", head, np.column_stack([T, Q, QD, TAU, Q, QD, TAU]))
    with pytest.raises(
        LogError, match=f"got positions of 2 arms: {first}.*, {second}.* expected columns of one arm"
    ):
        suggested(path, scara)


def test_cells_with_lists_and_names_as_texts(scara, tmp_path):
    order, names = [3, 1, 0, 2], [x.name for x in scara.chain.coordinates]
    texts = [str([names[k] for k in order])] * len(T)
    lists = [[str(list(map(float, x[order]))) for x in values] for values in (Q, QD, TAU)]
    rows = zip(T, texts, *lists, strict=True)
    require_same(suggested(written(tmp_path / "log.csv", ["t", "name", "pos", "vel", "trq"], rows), scara)[0])


def test_matrices_of_an_archive(scara, tmp_path):
    np.savez(tmp_path / "log.npz", time=T, positions=Q, velocities=QD, torques=TAU, image=np.zeros((3, 3)))
    require_same(suggested(tmp_path / "log.npz", scara)[0])


def test_the_command_writes_the_mapping_and_uses_it(robots, tmp_path):
    head = ["time", "pos1", "pos2", "pos3", "pos4", "effort1"]
    path = written(tmp_path / "log.csv", head, [[t, *q, tau[0]] for t, q, tau in zip(T, Q, TAU, strict=True)])
    command = [
        "logs",
        str(path),
        "--robot",
        str(robots / "scara.urdf"),
        "--suggest",
        str(tmp_path / "map.yaml"),
    ]
    told = CliRunner().invoke(app, command)
    assert told.exit_code == 1
    assert "no column was found for tau of joint1, tau of joint2" in told.stderr
    assert (tmp_path / "map.yaml").exists()
    assert "this output exists already" in CliRunner().invoke(app, command).stderr
    head += ["effort2", "effort3", "effort4"]
    written(path, head, [[t, *q, *tau] for t, q, tau in zip(T, Q, TAU, strict=True)])
    told = CliRunner().invoke(app, [*command, "--force"])
    assert told.stdout.startswith(
        f"wrote {tmp_path}/map.yaml; check it, then pass it by --mapping\nscara: 1 trajectory"
    )


def test_words_for_commands_in_names_of_joints_are_not_commands(scara, tmp_path):
    """Measured positions of a servo (q_target) are not confused with commands if a joint is named "target" or "set"."""
    text = (scara.robot.path).read_text()
    names = ["d", "target", "e", "set"]
    for k, name in enumerate(names):
        text = text.replace(f'"joint{k + 1}"', f'"{name}"')
    (tmp_path / "arm.urdf").write_text(text)
    head = ["t", *(f"{x}_{name}" for x in ("q", "cmd") for name in names)]
    path = written(tmp_path / "log.csv", head, np.column_stack([T, Q, Q]))
    draft = suggest_mapping(path, names, commands=True)
    assert not draft.missing
    for name in names:
        assert f'"q": "q_{name}", "u": "cmd_{name}"' in draft.text


@pytest.mark.parametrize("command, measured", [("u", "q"), ("goal_position", "present_position")])
def test_commands_beside_a_load_register_are_those_of_servos(scara, tmp_path, command, measured):
    names = [x.name for x in scara.chain.coordinates]
    head = ["t", *(f"{x}_{name}" for x in (measured, command, "load") for name in names)]
    path = written(tmp_path / "log.csv", head, np.column_stack([T, Q, Q, TAU]))
    with pytest.raises(LogError, match=r"got commanded positions and no torques.*write 'input: position'"):
        suggest_mapping(path, names)
    assert f'"u": "{command}_{names[0]}"' in suggest_mapping(path, names, commands=True).text


NAMES = {
    "positions by the names of joints": (("waist", "wrist_angle", "set_joint", "arm_pos"), "{}", "{}_vel", "{}_eff"),
    "names that are words of signals": (
        ("waist", "wrist_angle", "speed_joint", "arm_pos"), "/arm/{}/position", "/arm/{}/velocity", "/arm/{}/effort",
    ),
    "names without a common word": (
        ("base_pan_joint", "base_lift_joint", "wrist_1_joint", "wrist_2_joint"), "q_{}", "qd_{}", "tau_{}",
    ),
    "letters of names with numbers": (
        ("joint_1_s", "joint_2_l", "joint_3_u", "joint_4_t"), "FBPOS_{}", "speed_{}", "TRQ_{}",
    ),
}  # fmt: skip


@pytest.mark.parametrize("form", NAMES)
def test_joints_are_found_by_the_distinct_parts_of_their_names(scara, tmp_path, form):
    """Columns are assigned to joints by name, not by order: by the joint's name or the part that distinguishes it."""
    names, *patterns = NAMES[form]
    text = scara.robot.path.read_text()
    for k, name in enumerate(names):
        text = text.replace(f'"joint{k + 1}"', f'"{name}"')
    (tmp_path / "arm.urdf").write_text(text)
    arm = load_arm(tmp_path / "arm.urdf")
    short = {
        "names without a common word": lambda x: x.removesuffix("_joint"),
        "letters of names with numbers": lambda x: x[-1].upper(),
    }
    labels = list(map(short.get(form, str), names))
    order = [2, 0, 3, 1]
    head = ["Time", *(pattern.format(labels[k]) for pattern in patterns for k in order)]
    path = written(tmp_path / "log.csv", head, np.column_stack([T, Q[:, order], QD[:, order], TAU[:, order]]))
    require_same(suggested(path, arm)[0])


@pytest.mark.parametrize("place", ["names", "line below the header"])
def test_units_may_differ_between_joints(scara, tmp_path, place):
    """The suggested mapping has units per joint, from column names or from a line below the header.

    For example, the positions of a SCARA are in degrees at turning joints and in mm at the sliding joint.
    """
    types = scara.chain.joint_types
    factors = np.array([180 / np.pi if kind == "revolute" else 1e3 for kind in types])
    units = [("deg", "deg/s", "Nm") if kind == "revolute" else ("mm", "mm/s", "N") for kind in types]
    words = ("pos", "vel", "force")
    head, line = ["time"], ["ms"]
    for k, word in enumerate(words):
        head += [
            f"J{joint + 1} {word}" + (f" [{units[joint][k]}]" if place == "names" else "")
            for joint in range(4)
        ]
        line += [units[joint][k] for joint in range(4)]
    rows = np.column_stack([T * 1e3, Q * factors, QD * factors, TAU]).tolist()
    path = written(tmp_path / "log.csv", head, rows if place == "names" else [line, *rows])
    require_same(suggested(path, scara)[0])
    # a joint without a unit does not get the unit of the others
    head = [x.replace(" [mm]", "").replace(" [mm/s]", "") for x in head]
    factors = np.where(factors == 1e3, 1.0, factors)
    if place == "names":
        rows = np.column_stack([T * 1e3, Q * factors, QD * factors, TAU])
        require_same(suggested(written(tmp_path / "other.csv", head, rows), scara)[0])


def test_units_below_the_header_are_not_ignored(scara, tmp_path):
    head = ["t", *(f"{x}_{name}" for x in ("q", "qd", "tau") for name in scara.chain.joint_names)]
    line = ["s", *["rad"] * 4, *["rad/s"] * 4, *["mNm"] * 4, "m/s2"]
    path = written(
        tmp_path / "log.csv", [*head, "acc"], [line, *np.column_stack([T, Q, QD, TAU * 1e3, T]).tolist()]
    )
    names = scara.chain.joint_names
    with pytest.raises(
        LogError, match=r"units in a line below the header: tau: mNm, .*write 'units: \{tau: mNm\}'"
    ):
        read_logs(path, names)
    require_same(read_logs(path, names, {"units": {"tau": "mNm"}})[0])
    gains = {name: {"gain": 1e-3} for name in names}
    require_same(read_logs(path, names, {"joints": gains})[0])


@pytest.mark.parametrize("key", ["joints", "joint_names", "dof_names"])
def test_names_in_an_archive_give_the_order_of_its_matrices(scara, tmp_path, key):
    order = [3, 1, 0, 2]
    names = np.array(scara.chain.joint_names)[order]
    matrices = {"q": Q[:, order], "qd": QD[:, order], "tau": TAU[:, order]}
    np.savez(tmp_path / "log.npz", t=T, **matrices, **{key: names})
    require_same(read_logs(tmp_path / "log.npz", scara.chain.joint_names)[0])
    renamed = {"positions": matrices["q"], "velocities": matrices["qd"], "torques": matrices["tau"]}
    np.savez(tmp_path / "other.npz", time=T, **renamed, **{key: names.astype("S")})
    require_same(suggested(tmp_path / "other.npz", scara)[0])


@pytest.mark.parametrize("form", ["numbers", "signals"])
def test_a_row_per_signal_is_to_be_pivoted(scara, tmp_path, form):
    if form == "numbers":
        head, column = ["time", "axis", "pos", "torque"], "axis"
        rows = [
            [t, k, q, x]
            for t, *values in zip(T, Q, TAU, strict=True)
            for k, (q, x) in enumerate(zip(*values, strict=True))
        ]
    else:
        head, column = ["time", "signal", "value"], "signal"
        rows = [[t, f"q{k}", x] for t, values in zip(T, Q, strict=True) for k, x in enumerate(values)]
    with pytest.raises(LogError, match=rf"joints in the column '{column}'.*columns='{column}'\)"):
        suggest_mapping(written(tmp_path / "long.csv", head, rows), scara.chain.joint_names)


def test_empty_columns_are_not_drafted_and_other_clocks_are_listed(scara, tmp_path):
    head = [
        "stamp",
        "secs",
        "nsecs",
        "rosbagTimestamp",
        *(f"{x}{k}" for x in ("pos", "vel", "eff") for k in range(4)),
    ]
    rows = [
        ["", int(1.6e9 + t), round((t % 1) * 1e9), 1.6e9 + t + 0.003 * (k % 2), *values]
        for k, (t, values) in enumerate(zip(T, np.column_stack([Q, QD, TAU]).tolist(), strict=True))
    ]
    found, text = suggested(written(tmp_path / "log.csv", head, rows), scara)
    require_same(found)
    assert "# not used for t: rosbagTimestamp" in text


def test_lists_in_braces(scara, tmp_path):
    lists = [["{" + ", ".join(map(repr, x)) + "}" for x in values.tolist()] for values in (Q, QD, TAU)]
    rows = zip(T, *lists, strict=True)
    require_same(suggested(written(tmp_path / "log.csv", ["time", "Angle", "Spd", "Torque"], rows), scara)[0])


def test_leaders_command_followers(scara, tmp_path):
    names = scara.chain.joint_names
    head = ["t", *(f"{x}_{name}" for x in ("leader", "follower") for name in names)]
    draft = suggest_mapping(
        written(tmp_path / "log.csv", head, np.column_stack([T, Q, Q])), names, commands=True
    )
    assert f'"q": "follower_{names[0]}", "u": "leader_{names[0]}"' in draft.text


@pytest.mark.parametrize(
    ("form", "factor"),
    [
        (("q{} [turns]", "qd{} [turns/s]"), (1 / (2 * np.pi),) * 2),
        (("pos_{}_turns", "vel_{}_turns_s"), (1 / (2 * np.pi),) * 2),
        (("pos_{}_revolutions", "vel_{}_rps"), (1 / (2 * np.pi),) * 2),
        (("q{}_rad", "qd{}_deg_s"), (1, 180 / np.pi)),
        (("q{}_rad", "qd{}_deg_per_s"), (1, 180 / np.pi)),
        (("q{}_rad", "speed{}_deg_per_sec"), (1, 180 / np.pi)),
        (("q{} deg", "qd{} rad/sec"), (180 / np.pi, 1)),
        (("q{}_deg", "qd{}_radps"), (180 / np.pi, 1)),
        (("q{} (rad)", "qd{} (deg s^-1)"), (1, 180 / np.pi)),
        (("q{} [mrad]", "qd{}"), (1000, 1000)),
    ],
)
def test_units_of_velocities_are_read_in_each_notation(robots, tmp_path, form, factor):
    """A velocity without a unit has the unit of the position per second, and "deg_s" is deg/s."""
    head = ["t", *(name.format(k) for name in (*form, "tau{}") for k in range(2))]
    rows = np.column_stack([T, Q[:, :2] * factor[0], QD[:, :2] * factor[1], TAU[:, :2]])
    log, _ = suggested(written(tmp_path / "log.csv", head, rows), load_arm(robots / "two_link.urdf"))
    np.testing.assert_allclose(log.q, Q[:, :2], atol=1e-9)
    np.testing.assert_allclose(log.qd, QD[:, :2], atol=1e-9)


@pytest.mark.parametrize(
    ("measured", "computed"),
    [
        ("qfrc_actuator[{}]", "qfrc_bias[{}]"),
        ("applied_torque_{}", "computed_torque_{}"),
        ("tau_m{}", "tau_g{}"),
        ("tau{}_raw", "tau{}_filt"),
        ("actual_current_as_torque_{}", "actual_current_{}"),
        ("tau_measured{}", "tau_feedback{}"),
        ("tau_feedback{}", "tau_feedforward{}"),
    ],
)
@pytest.mark.parametrize("is_first", [True, False])
def test_measured_torques_are_preferred_to_computed_ones_and_currents(
    scara, tmp_path, measured, computed, is_first
):
    """Measured torques are read instead of computed torques, terms of a controller or currents, in any order."""
    torques = [(measured, TAU), (computed, 3 * TAU)]
    torques = torques if is_first else torques[::-1]
    head = ["t", *(name.format(k) for name in ("q{}", "qd{}", *(x for x, _ in torques)) for k in range(4))]
    rows = np.column_stack([T, Q, QD, *(x for _, x in torques)])
    require_same(suggested(written(tmp_path / "log.csv", head, rows), scara)[0])


def test_current_as_a_word_for_present_is_no_unit(scara, tmp_path):
    head = ["t", *(f"current_{x}{k}" for x in ("position", "velocity", "torque") for k in range(4))]
    log, text = suggested(written(tmp_path / "log.csv", head, np.column_stack([T, Q, QD, TAU])), scara)
    require_same(log)
    assert "gain" not in text


def test_minutes_of_a_clock_are_converted(scara, tmp_path):
    head = ["time [min]", *(f"{x}{k}" for x in ("q", "qd", "tau") for k in range(4))]
    path = written(tmp_path / "log.csv", head, np.column_stack([T / 60, Q, QD, TAU]))
    require_same(suggested(path, scara)[0])


def test_velocities_per_minute_are_converted(scara, tmp_path):
    """Velocities in rad/min and in mm/min, a unit of feed rates, are converted with the factor of their unit."""
    units, factors = ["rad per min", "rad/min"] * 2, np.full(4, 60.0)
    slider = log_source(scara).joint_types.index("prismatic")
    units[slider], factors[slider] = "mm/min", 60e3
    head = ["t", *(f"q{k}" for k in range(4)), *(f"qd{k} [{x}]" for k, x in enumerate(units))]
    rows = np.column_stack([T, Q, factors * QD, TAU])
    path = written(tmp_path / "log.csv", [*head, *(f"tau{k}" for k in range(4))], rows)
    require_same(suggested(path, scara)[0])


@pytest.mark.parametrize("index", [T, (1e9 * T).astype("datetime64[ns]")])
def test_an_index_of_pandas_without_a_name_is_the_clock(scara, tmp_path, index):
    """The first column of a CSV needs no name if its values are times: pandas writes an index so."""
    head = ["", *(f"{x}{k}" for x in ("q", "qd", "tau") for k in range(4))]
    rows = [[x, *row] for x, row in zip(index, np.column_stack([Q, QD, TAU]), strict=True)]
    require_same(suggested(written(tmp_path / "log.csv", head, rows), scara)[0])


@pytest.mark.parametrize("gripper", [0, 1])
def test_columns_of_a_free_base_at_rest_are_omitted(scara, tmp_path, gripper):
    """States of MuJoCo with a free base: the base has seven positions and six velocities, a gripper one of each."""
    signals = {"qpos": (7, Q), "qvel": (6, QD), "qfrc_actuator": (6, TAU)}
    log = {x: np.pad(values, ((0, 0), (base, gripper))) for x, (base, values) in signals.items()}
    np.savez(tmp_path / "log.npz", time=T, **log)
    require_same(suggested(tmp_path / "log.npz", scara)[0])


def test_exponents_of_fortran_are_read(scara, tmp_path):
    head = ["t", *(f"{x}{k}" for x in ("q", "qd", "tau") for k in range(4))]
    rows = [[f"{x:.15E}".replace("E", "D") for x in row] for row in np.column_stack([T, Q, QD, TAU])]
    require_same(suggested(written(tmp_path / "log.csv", head, rows), scara)[0])


@pytest.mark.parametrize("text", ["missing", "#DIV/0!", "nan(ind)", "1.#INF"])
def test_texts_for_no_value_are_gaps(scara, tmp_path, text):
    """A cell with a text such as "#DIV/0!" for an absent value is an error that states the setting `dropouts: dropped`.

    With this setting such rows are omitted.
    """
    head = ["t", *(f"{x}{k}" for x in ("q", "qd", "tau") for k in range(4))]
    rows = np.column_stack([T, Q, QD, TAU]).tolist()
    rows[5][3] = text
    with pytest.raises(LogError, match="dropouts: dropped"):
        suggested(written(tmp_path / "log.csv", head, rows), scara)


def test_matrices_with_a_column_per_time_are_to_be_transposed(scara, tmp_path):
    np.savez(tmp_path / "log.npz", t=T, q=Q.T, qd=QD.T, tau=TAU.T)
    with pytest.raises(LogError, match="transpose it: rows are times"):
        suggested(tmp_path / "log.npz", scara)


def test_a_joint_at_rest_between_moving_joints_is_not_omitted_for_a_moving_gripper(scara, tmp_path):
    """Five numbered columns of an arm with four joints: joint 2 rests and the gripper moves."""
    head = ["t", *(f"{x}{k}" for x in ("q", "qd", "tau") for k in range(5))]
    rest = [np.where(np.arange(4) == 1, values[:1], values) for values in (Q, QD, TAU)]
    rows = np.column_stack([T, *(np.column_stack([x, np.sin(5 * T)]) for x in rest)])
    found, text = suggested(written(tmp_path / "log.csv", head, rows), scara)
    np.testing.assert_allclose(found.q, rest[0], atol=1e-9)
    np.testing.assert_allclose(found.tau, rest[2], atol=1e-9)
    assert "# not used for q: q4" in text


def test_columns_of_a_base_or_gripper_at_rest_are_named_in_the_draft(scara, tmp_path):
    head = ["t", *(f"{x}{k}" for x in ("q", "qd", "tau") for k in range(5))]
    rows = np.column_stack([T, *(np.column_stack([np.zeros(200), x]) for x in (Q, QD, TAU))])
    found, text = suggested(written(tmp_path / "log.csv", head, rows), scara)
    require_same(found)
    assert "# not used for q: q0" in text


@pytest.mark.parametrize("names", [("j{}", "vel_{}", "tau_{}"), ("mp{}", "qd{}", "mt{}")])
def test_positions_named_by_their_joint_alone_and_short_names_of_kuka(scara, tmp_path, names):
    """`j1` is the position of joint 1. KUKA's interface FRI has `mp`, `ip`, `mt` and `et`: measured and commanded
    positions, measured and external torques.
    """
    others = {"ip{}": Q + 0.1, "et{}": TAU + 1.0} if names[0] == "mp{}" else {}
    signals = dict(zip(names, (Q, QD, TAU), strict=True)) | others
    head = ["time", *(name.format(k + 1) for name in signals for k in range(4))]
    rows = np.column_stack([T, *signals.values()])
    require_same(suggested(written(tmp_path / "log.csv", head, rows), scara)[0])


def test_a_draft_does_not_replace_the_settings_beside_the_urdf(scara, tmp_path):
    (tmp_path / "arm.urdf").write_text(scara.robot.path.read_text())
    names = [f"{x}{k}" for x in ("q", "qd", "tau") for k in range(4)]
    log = written(tmp_path / "log.csv", ["t", *names], np.column_stack([T, Q, QD, TAU]))
    robot = str(tmp_path / "arm.urdf")
    words = ["logs", str(log), "--robot", robot, "--suggest", str(tmp_path / "arm.yaml"), "--force"]
    result = CliRunner().invoke(app, words)
    assert result.exit_code and "settings of the robot" in result.output + str(result.exception)
    assert not (tmp_path / "arm.yaml").exists()
