"""Suggested mappings read the original values from logs in the formats of public simulators and robot drivers."""

import json
import subprocess
import sys

import numpy as np
import pyarrow as pa
import pyarrow.parquet
import pytest
from test_suggest import QD, TAU, Q, T, require_same, scara, suggested, written

from spelgen.arm.configured_arm import load_arm
from spelgen.errors import LogError
from spelgen.logs.formats import log_files
from spelgen.logs.read import read_logs
from spelgen.logs.suggest import suggest_mapping

__all__ = ["scara"]  # a fixture
STATES = [
    {"position": q, "velocity": qd, "effort": tau}
    for q, qd, tau in zip(Q.tolist(), QD.tolist(), TAU.tolist(), strict=True)
]


def documents(names):
    """Return {layout: JSON document}: the same recording in six layouts that the reader accepts."""
    stamps = [{"sec": int(t), "nanosec": round(t % 1 * 1e9)} for t in T.tolist()]
    order = [2, 0, 3, 1]
    points = [
        {
            "time_from_start": stamp, "positions": q[order].tolist(), "velocities": qd[order].tolist(),
            "effort": tau[order].tolist(),
        }
        for stamp, q, qd, tau in zip(stamps, Q, QD, TAU, strict=True)
    ]  # fmt: skip
    joints = [
        {"name": name, "position": Q[:, k].tolist(), "velocity": QD[:, k].tolist(), "torque": TAU[:, k].tolist()}
        for k, name in enumerate(names)
    ]  # fmt: skip
    motors = [
        {"ts": t, "motors": [{"id": k, "q": q[k], "dq": qd[k], "tauEst": tau[k]} for k in range(4)]}
        for t, q, qd, tau in zip(T.tolist(), Q.tolist(), QD.tolist(), TAU.tolist(), strict=True)
    ]
    return {
        "an object per row": [{"time": t, **state} for t, state in zip(T.tolist(), STATES, strict=True)],
        "nested rows": {
            "robot": {"name": "x", "gains": [1, 2]},
            "samples": [{"t": t, "state": s} for t, s in zip(T.tolist(), STATES, strict=True)],
        },
        "a list per signal": {"time": T.tolist(), "q": Q.tolist(), "dq": QD.tolist(), "tau": TAU.tolist()},
        "an object per joint": {"time": T.tolist(), "joints": joints},
        "a trajectory of MoveIt": {"joint_trajectory": {"joint_names": [names[k] for k in order], "points": points}},
        "an object per motor": motors,
    }  # fmt: skip


FORMS = list(documents(["a", "b", "c", "d"]))


@pytest.mark.parametrize("form", FORMS)
def test_json_documents_are_read_in_each_form(scara, tmp_path, form):
    (tmp_path / "log.json").write_text(json.dumps(documents(scara.chain.joint_names)[form]))
    require_same(suggested(tmp_path / "log.json", scara)[0])


@pytest.mark.parametrize("suffix", [".jsonl", ".parquet"])
def test_lists_of_objects_are_read(scara, tmp_path, suffix):
    rows = documents(scara.chain.joint_names)["an object per motor"]
    path = tmp_path / f"log{suffix}"
    if suffix == ".parquet":
        pa.parquet.write_table(pa.Table.from_pylist(rows), path)
    else:
        path.write_text("".join(f"{json.dumps(row)}\n" for row in rows))
    require_same(suggested(path, scara)[0])


@pytest.mark.parametrize("text", ["[" * 10**5, '{"t": [1, 2', "[]", "3"])
def test_other_json_is_one_error(scara, tmp_path, text):
    (tmp_path / "log.json").write_text(text)
    with pytest.raises(LogError, match=r"log\.json"):
        read_logs(tmp_path / "log.json", scara)


def test_json_beside_logs_is_metadata(scara, tmp_path):
    head = ["t", *(f"{x}_{name}" for x in ("q", "qd", "tau") for name in scara.chain.joint_names)]
    written(tmp_path / "log.csv", head, np.column_stack([T, Q, QD, TAU]))
    (tmp_path / "meta.json").write_text("{}")
    require_same(read_logs(tmp_path, scara)[0])


def test_yaml_of_ros2_topic_echo_is_converted_by_the_advised_command(scara, tmp_path):
    lines = []
    for t, state in zip(T.tolist(), STATES, strict=True):
        stamp = f"header:\n  stamp:\n    sec: {int(t)}\n    nanosec: {round(t % 1 * 1e9)}\n"
        lists = "".join(
            f"{name}:\n" + "".join(f"- {x!r}\n" for x in values) for name, values in state.items()
        )
        lines.append(f"{stamp}{lists}---\n")
    (tmp_path / "log.txt").write_text("".join(lines))
    (error,) = log_files(tmp_path / "log.txt")[1]
    command = error.do.removeprefix("convert it: ").replace("python", sys.executable, 1)
    subprocess.run(command, shell=True, check=True)
    require_same(suggested(tmp_path / "log.jsonl", scara)[0])


def test_logs_in_folders_of_a_folder_are_named(tmp_path):
    (tmp_path / "logs/first").mkdir(parents=True)
    written(tmp_path / "logs/first/log.csv", ["t"], [[0]])
    (error,) = log_files(tmp_path / "logs")[1]
    assert error.do == "name the folders in it, which have logs"


@pytest.mark.parametrize("between", ["", "\n# second run\n"])
def test_a_repeated_header_begins_a_recording_where_the_clock_goes_back(scara, tmp_path, between):
    head = ["t", *(f"{x}_{name}" for x in ("q", "qd", "tau") for name in scara.chain.joint_names)]
    text = written(tmp_path / "log.csv", head, np.column_stack([T, Q, QD, TAU]).tolist()).read_text()
    (tmp_path / "log.csv").write_text(text + between + text)
    logs = read_logs(tmp_path / "log.csv", scara)
    assert [log.name for log in logs] == ["1", "2"]
    for log in logs:
        require_same(log)
    header, *lines = text.splitlines(keepends=True)
    (tmp_path / "log.csv").write_text("".join([header, *lines[:90], header, *lines[90:]]))
    (log,) = read_logs(tmp_path / "log.csv", scara)
    require_same(log)
    (tmp_path / "log.csv").write_text("".join([*text, header, *lines[:5], lines[5].replace("0.", "zero", 1)]))
    with pytest.raises(LogError, match=r"log\.csv:208: row 6, column"):
        read_logs(tmp_path / "log.csv", scara)


UNITS = {
    "[0.01 deg]": (18000 / np.pi, "q"), "(x1000 rad)": (1e3, "q"), "[mdeg]": (180e3 / np.pi, "q"),
    "[0.1 deg/s]": (1800 / np.pi, "qd"), "[1e-3 N.m]": (1e3, "tau"), "[kNm]": (1e-3, "tau"), "[0.1 ms]": (1e4, "t"),
    "[lbf ft]": (1 / 1.355817948, "tau"),
}  # fmt: skip


@pytest.mark.parametrize("unit", UNITS)
def test_units_may_have_a_factor(robots, tmp_path, unit):
    factor, of = UNITS[unit]
    signals = {"t": T, "q": Q[:, :2], "qd": QD[:, :2], "tau": TAU[:, :2]}
    head = [
        f"t {unit * (of == 't')}",
        *(
            f"{x}{k} {unit if of == x else '[rad/s]' * (x == 'qd')}"
            for x in ("q", "qd", "tau")
            for k in range(2)
        ),
    ]
    rows = np.column_stack([values * (factor if x == of else 1) for x, values in signals.items()])
    arm = load_arm(robots / "two_link.urdf")
    log, _ = suggested(written(tmp_path / "log.csv", head, rows), arm)
    for name, values in signals.items():
        np.testing.assert_allclose(getattr(log, name), values, rtol=1e-8, atol=1e-8)


def test_factors_of_units_are_settings_also_for_commands(robots, tmp_path):
    names = ["joint1", "joint2"]
    head = ["t", *(f"{x}_{name}" for x in ("q", "u") for name in names)]
    path = written(tmp_path / "log.csv", head, np.column_stack([T, Q[:, :2], Q[:, :2]]))
    mapping = {"units": {"q": "0.01 deg"}, "input": "position"}
    (log,) = read_logs(path, names, mapping)
    np.testing.assert_allclose(log.u, Q[:, :2] * np.pi / 18000)
    (log,) = read_logs(path, names, mapping | {"joints": {"joint1": {"units": {"q": "rad"}}}})
    np.testing.assert_allclose(log.q, Q[:, :2] * [1, np.pi / 18000])


COLUMNS = {
    "PyBullet": ("q{}", "u{}", "t{}"),
    "velocities v and inputs u": ("q{}", "v{}", "u{}"),
    "commanded torques only": ("q_{}", "dq_{}", "tau_d_{}"),
    "KUKA RSI": ("AIPos.A{}", "AIVel.A{}", "Torque.A{}", "ASPos.A{}"),
    "Staubli": ("JPOS{}", "JVEL{}", "JTRQ{}", "JCMD{}"),
    "CyberGear": ("m{}.mech_pos", "m{}.mech_vel", "m{}.iqf"),
    "compounds": ("Gelenkwinkel_A{}", "Gelenkgeschwindigkeit_A{}", "Gelenkmoment_A{}", "Sollwinkel_A{}"),
    "lower-case compounds": ("jointposition{}", "jointvelocity{}", "jointtorque{}", "targetposition{}"),
    "Japanese": ("関節{}角度", "関節{}速度", "関節{}トルク", "関節{}目標角度"),
    "Japanese in half width": ("関節{}角度", "関節{}速度", "関節{}ﾄﾙｸ"),
    "Korean": ("관절{} 위치", "관절{} 속도", "관절{} 토크", "관절{} 목표 위치"),
    "Italian": ("posizione_{}", "velocità_{}", "coppia_{}"),
    "Russian": ("положение{}", "скорость{}", "момент{}"),
}  # fmt: skip


@pytest.mark.parametrize("source", COLUMNS)
def test_columns_of_public_sources_are_found(scara, tmp_path, source):
    head = ["時刻" if "関" in COLUMNS[source][0] else "time"]
    head += [name.format(k) for name in COLUMNS[source] for k in range(1, 5)]
    rows = np.column_stack([T, Q, QD, TAU, *[Q + 1] * (len(COLUMNS[source]) - 3)])
    require_same(suggested(written(tmp_path / "log.csv", head, rows), scara)[0])


def test_inputs_that_are_close_to_the_positions_are_commands(scara, tmp_path):
    head = ["t", *(f"{x}{k}" for x in ("q", "u") for k in range(4))]
    path = written(tmp_path / "log.csv", head, np.column_stack([T, Q, Q + 0.001 * QD]))
    with pytest.raises(LogError, match="got commanded positions and no torques"):
        suggest_mapping(path, scara.chain.joint_names)


@pytest.mark.parametrize("letter", "tu")
def test_letters_are_no_torques_if_the_log_has_torques(scara, tmp_path, letter):
    """Columns named by a single letter are not read as torques if the log has torques: t may be temperatures."""
    head = ["time", *(f"{x}{k}" for x in ("q", "qd", "tau", letter) for k in range(4))]
    rows = np.column_stack([T, Q, QD, TAU, 30 + TAU])
    require_same(suggested(written(tmp_path / "log.csv", head, rows), scara)[0])


def test_commanded_currents_are_no_torques(scara, tmp_path):
    head = [
        "time",
        *(f"{x}_{k}" for x in ("present_position", "goal_position", "goal_current") for k in range(4)),
    ]
    path = written(tmp_path / "log.csv", head, np.column_stack([T, Q, Q, TAU]))
    with pytest.raises(LogError, match="got commanded positions and no torques"):
        suggest_mapping(path, scara.chain.joint_names)


def test_numbers_of_pandas_for_equal_names_begin_with_the_second(scara, tmp_path):
    head = [
        "time",
        *(f"{x}.{k}".removesuffix(".0") for x in ("position", "velocity", "effort") for k in range(4)),
    ]
    require_same(suggested(written(tmp_path / "log.csv", head, np.column_stack([T, Q, QD, TAU])), scara)[0])


def test_equal_names_are_one_error(scara, tmp_path):
    head = ["time", *["pos"] * 4, *["vel"] * 4, *["effort"] * 4]
    path = written(tmp_path / "log.csv", head, np.column_stack([T, Q, QD, TAU]))
    with pytest.raises(
        LogError, match=r"the same name for several columns: pos, vel, effort.*number them: pos1"
    ):
        suggest_mapping(path, scara.chain.joint_names)


@pytest.mark.parametrize("place", [0, 4])
def test_of_more_columns_than_joints_the_moving_ones_are_taken(scara, tmp_path, place):
    head = ["t", *(f"{x}{k}" for x in ("q", "qd", "tau") for k in range(5))]
    rows = np.column_stack([T, *(np.insert(x, place, 0.4, axis=1) for x in (Q, QD, TAU))])
    require_same(suggested(written(tmp_path / "log.csv", head, rows), scara)[0])


def test_units_of_some_columns_in_a_line_below_the_header_are_used(robots, tmp_path):
    head = ["t", *(f"{x}{k}" for x in ("q", "qd", "tau") for k in range(2))]
    rows = np.column_stack([T, Q[:, :2] * 180 / np.pi, QD[:, :2], TAU[:, :2]]).tolist()
    units = ["", "deg", "deg", "rad/s", "rad/s", "", ""]
    log, _ = suggested(
        written(tmp_path / "log.csv", head, [units, *rows]), load_arm(robots / "two_link.urdf")
    )
    np.testing.assert_allclose(log.q, Q[:, :2], atol=1e-9)


def test_decimal_commas_in_texts_of_json_are_read(scara, tmp_path):
    head = ["t", *(f"{x}{k}" for x in ("q", "qd", "tau") for k in range(4))]
    rows = np.column_stack([T, Q, QD, TAU]).tolist()
    lines = [
        json.dumps({name: f"{x:.12f}".replace(".", ",") for name, x in zip(head, row, strict=True)})
        for row in rows
    ]
    (tmp_path / "log.jsonl").write_text("\n".join(lines))
    require_same(suggested(tmp_path / "log.jsonl", scara)[0])
    lines = [line.replace(f"{rows[3][1]:.12f}".replace(".", ","), "1.234,5") for line in lines]
    (tmp_path / "log.jsonl").write_text("\n".join(lines))
    with pytest.raises(
        LogError, match=r"got '1\.234,5', expected a number; write numbers without separators of thou"
    ):
        read_logs(tmp_path / "log.jsonl", scara, tmp_path / "log.yaml")


def test_other_arrays_of_an_archive_are_named_or_not_needed(scara, tmp_path):
    arrays = {"time": T, "positions": Q, "velocities": QD, "torques": TAU}
    np.savez(tmp_path / "log.npz", info=np.array({"robot": "x"}, dtype=object), **arrays)
    require_same(suggested(tmp_path / "log.npz", scara)[0])
    faults = {
        "an array of shape .2, 200, 4.*split it by recordings": {
            x: np.stack([y, y]) for x, y in arrays.items()
        },
        "expected a row for each of the 201 times": arrays | {"positions": np.vstack([Q, Q[-1:]])},
        "store its fields: numpy": {"log": np.zeros(9, dtype=[("t", float), ("q", float)])},
    }
    for number, (message, content) in enumerate(faults.items()):
        np.savez(tmp_path / f"{number}.npz", **content)
        with pytest.raises(LogError, match=message):
            suggest_mapping(tmp_path / f"{number}.npz", scara.chain.joint_names)
