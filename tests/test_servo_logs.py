"""`spelgen logs` reports the tracking of servos, and faults of logs with commanded positions."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from servo_arm import servo_logs, write_servo_arm
from typer.testing import CliRunner

import spelgen
from spelgen.cli.main import app
from spelgen.errors import LogError
from spelgen.logs.parquet_files import UNLESS_NORMALISED
from spelgen.logs.trajectory import Trajectory
from spelgen.settings.log_mapping import LogMapping

SETTINGS = "input: position\njoints: {shoulder: {kp: 14.0}}\n"


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    return spelgen.load_arm(write_servo_arm(tmp_path_factory.mktemp("servo"), SETTINGS))


@pytest.fixture(scope="module")
def logs():
    return servo_logs(3, 12.0)


def changed(logs, **columns):
    """Return the logs with columns replaced: a function of the trajectory per column."""
    return [replace(x, **{name: made(x) for name, made in columns.items()}) for x in logs]


def codes(report):
    return {each.code for each in report.findings}


def test_the_report_of_logs_of_a_servo_arm(arm, logs):
    found = spelgen.check_logs(logs, arm)
    assert not found.errors and not found.warnings
    shoulder, elbow = found.joints
    assert shoulder.steps["q"] == pytest.approx(2 * np.pi / 4096, rel=1e-6)
    assert shoulder.steps["u"] is None
    assert shoulder.low["u"] == min(x.u[:, 0].min() for x in logs)
    assert shoulder.high["u"] == max(x.u[:, 0].max() for x in logs)
    assert 0.05 < shoulder.following.lag < 0.15  # the lag is the delay plus kd/kp [s]
    assert shoulder.following.saturated < 0.02 and elbow.following.saturated is None
    # the command never stays constant, so that no steady state exists
    assert shoulder.following.steady_state_error is None
    for text in ("Ranges [rad]", "Following", "No findings."):
        assert text in found.text()
    told = json.loads(json.dumps(found.to_dict()))
    assert told["joints"][1]["name"] == "elbow"


def test_the_command_prints_the_report(arm, logs, tmp_path):
    path = spelgen.write_logs(tmp_path / "logs.csv", logs, arm)
    command = ["logs", str(path), "--robot", str(arm.robot.path), "--html", str(tmp_path / "page.html")]
    told = CliRunner().invoke(app, command)
    assert told.exit_code == 0, told.output
    assert "Following" in told.stdout
    page = (tmp_path / "page.html").read_text()
    assert "position of elbow" in page and "commanded" in page


@pytest.mark.parametrize(
    ("columns", "text"),
    [
        ({"u": lambda x: np.degrees(x.u)}, r"'shoulder', 'elbow': got positions that move 0\.016\d* times as far as"),
        ({"u": lambda x: -x.u}, r"joint 'shoulder', 'elbow': got positions that move against commands \(correlation -"),
        ({"u": lambda x: np.diff(x.u, axis=0, prepend=x.u[:1])}, r"'elbow': got increments: the position follows"),
    ],
)  # fmt: skip
def test_impossible_commands_are_errors(arm, logs, columns, text):
    found = spelgen.check_logs(changed(logs, **columns), arm)
    assert any(re.search(text, str(each)) for each in found.errors)


def test_exchanged_commands_are_one_error_with_one_line(arm, logs):
    exchanged = changed(logs, u=lambda x: x.u[:, ::-1])
    (error,) = map(str, spelgen.check_logs(exchanged, arm).errors)
    assert error.startswith("joint 'shoulder', 'elbow': got commands that other joints follow")
    line = "joints: {shoulder: {columns: {u: u_elbow}}, elbow: {columns: {u: u_shoulder}}}"
    assert f"write '{line}' under 'logs'" in error


def only(column, values):
    """Return a function that gives a log's commands, (T, n), with one column replaced by `values`."""

    def made(x):
        u = x.u.copy()
        u[:, column] = values(x)[:, column] if callable(values) else values
        return u

    return made


@pytest.mark.parametrize(
    ("columns", "code"),
    [
        ({"u": lambda x: x.q}, "commands-are-positions"),
        ({"u": only(0, 0.3)}, "idle-command"),
        ({"u": only(1, lambda x: np.roll(x.u, 500, axis=0))}, "not-following"),
        ({"u": lambda x: np.concatenate([x.u[:1].repeat(10, axis=0), x.u[:-10]])}, "ahead-of-command"),
        ({"u": lambda x: x.u + 3.0}, "beyond-position-limit"),
        ({"u": lambda x: x.u + np.radians([0, 20])}, "command-offset"),
    ],
)
def test_anomalous_commands_are_reported(arm, logs, columns, code):
    found = spelgen.check_logs(changed(logs, **columns), arm)
    assert code in codes(found)


def test_a_joint_that_rests_at_its_command_does_not_have_copied_commands(arm, logs):
    def column(value):
        return lambda x: np.column_stack([x.qd[:, 0] if value == 0 else x.q[:, 0], np.full(len(x), value)])

    resting = changed(logs, u=only(1, 0.25), q=column(0.25), qd=column(0.0))
    found = codes(spelgen.check_logs(resting, arm))
    assert "idle-command" in found and "commands-are-positions" not in found


def test_errors_at_rest_are_reported(arm):
    shoulder, elbow = spelgen.check_logs(servo_logs(2, 12.0, swing=0.0), arm).joints
    # error at rest: up to (dry friction + gravity torque) / kp
    assert 0.3 * 0.15 / 14 < shoulder.following.steady_state_error < (0.15 + 0.9) / 14
    assert 0.3 * 0.08 / 9 < elbow.following.steady_state_error < (0.08 + 0.16) / 9


def test_saturated_servos_are_counted(arm):
    far = [replace(x, u=x.u + np.array([6 / 14 + 0.2, 0.0])) for x in servo_logs(1, 8.0)]
    shoulder = spelgen.check_logs(far, arm).joints[0]
    assert 0.5 < shoulder.following.saturated <= 1.0


def test_sparse_logs_are_reported(arm, logs):
    slow = [x[::4] for x in logs]
    assert "sparse" in codes(spelgen.check_logs(slow, arm))


@pytest.mark.parametrize("samples", [1, 5, 13, 400])
def test_logs_with_any_commands_have_a_report(arm, samples):
    t = np.arange(samples) * 0.02
    ramp = np.stack([0.5 * t, np.full_like(t, 0.1)], axis=1)
    for u in (ramp, 0 * ramp, 1e8 * ramp):
        log = Trajectory(t, ramp, np.full_like(ramp, 0.5) * [1, 0], np.zeros((samples, 0)), u=u)
        assert "Following" in spelgen.check_logs([log], arm).text()


def test_commands_without_torques_ask_for_the_setting(tmp_path):
    arm = spelgen.load_arm(write_servo_arm(tmp_path, ""))
    names = [f"{quantity}_{joint}" for joint in ("shoulder", "elbow") for quantity in ("q", "u")]
    (tmp_path / "log.csv").write_text(",".join(["t", *names]) + "\n0,0,0,0,0\n0.02,0,0,0,0\n")
    with pytest.raises(LogError, match="write 'input: position' into the YAML beside the URDF"):
        spelgen.read_logs(tmp_path / "log.csv", arm)


def test_counts_of_encoders_without_a_unit_are_not_called_milliradians(arm, logs):
    counts = changed(
        logs, q=lambda x: np.round(x.q * 4096 / (2 * np.pi) + 2048), u=lambda x: x.u * 652 + 2048
    )
    (error,) = (x for x in spelgen.check_logs(counts, arm).errors if "more than two turns" in str(x))
    assert "whole numbers: counts of an encoder need 'counts_per_turn'" in str(error)
    assert "mrad" not in str(error)


DEGREES = LogMapping.model_validate({"input": "position", "units": {"q": "deg"}})


@pytest.mark.parametrize("seed", range(4))
def test_normalised_positions_declared_as_degrees_are_found_by_their_steps(arm, logs, seed):
    # encoder counts of each motor's calibrated range, to which 200 normalised units correspond
    counts = np.random.default_rng(seed).integers(1100, 2600, 2)
    step = np.radians(200 / counts)
    wrong = changed(logs, q=lambda x: np.round(x.q / step) * step, mapping=lambda x: DEGREES)
    (error,) = spelgen.check_logs(wrong, arm).errors
    assert all(
        f"{name} {200 / count:.4f}" in str(error)
        for name, count in zip(arm.chain.joint_names, counts, strict=True)
    )
    assert "write 'units: {q: normalised}' and 'calibration:'" in str(error)
    warning = f"positions within -100..100: right as deg, {UNLESS_NORMALISED}"
    accepted = changed(wrong, accepted=lambda x: ("normalised",), repairs=lambda x: (warning,))
    report = spelgen.check_logs(accepted, arm)
    # With 'accept: [normalised]' in the settings there is no error. The warning of the file reader, that the positions
    # may be normalised, is then reported; otherwise the error replaces it.
    assert not report.errors and any(warning in x.message for x in report.findings)


@pytest.mark.parametrize("turns", [(4096, 4096), (4095, 4095), (4096, 1024), (16384, 4096), (3600, 3600)])
def test_degrees_of_encoders_and_rounded_degrees_are_no_normalised_positions(arm, logs, turns):
    step = 2 * np.pi / np.array(turns)
    right = changed(logs, q=lambda x: np.round(x.q / step) * step, mapping=lambda x: DEGREES)
    assert not spelgen.check_logs(right, arm).errors


def test_commands_in_radians_beside_positions_in_degrees_are_an_error_with_the_line(arm, logs):
    # The mapping states degrees for positions and commands. Commands in rad are therefore multiplied by pi / 180, too,
    # and are nearly constant.
    small = changed(logs, u=lambda x: np.radians(x.u))
    errors = [str(error) for error in spelgen.check_logs(small, arm).errors]
    assert len(errors) == 1
    assert (
        "joint 'shoulder', 'elbow': got" in errors[0] and "write 'units: {q: deg, u: rad}' under" in errors[0]
    )


@pytest.mark.parametrize("counts", [None, 1024, 4096])
@pytest.mark.parametrize(("stated", "logged"), [("deg", "rad"), ("rad", "deg")])
def test_a_unit_of_servos_that_is_stated_wrongly_is_named_with_the_line(arm, logs, stated, logged, counts):
    factor = np.pi / 180 if stated == "deg" else 180 / np.pi
    step = 0.0 if counts is None else 2 * np.pi / counts

    def wrong(values):
        return factor * (np.round(values / step) * step if step else values)

    mapping = LogMapping.model_validate({"input": "position", "units": {"q": stated}})
    small = changed(logs, q=lambda x: wrong(x.q), u=lambda x: wrong(x.u), mapping=lambda x: mapping)
    errors = [str(error) for error in spelgen.check_logs(small, arm).errors]
    if (
        stated == "rad" and counts is None
    ):  # without encoder steps, a wrong unit of positions is found by their many turns
        assert all("jump" in error or f"units: {{q: {logged}" in error for error in errors)
        return
    assert any(f"write 'units: {{q: {logged}}}' under 'logs'" in error for error in errors), errors


def only_rows(x, column, rows, value):
    """Return a copy of the log `x` in which `value` replaces the positions q[rows, column] of joint `column`.

    value: position [rad], or a function that returns it from all positions (T,) of the joint. The velocities are dq/dt.
    """
    q = x.q.copy()
    q[rows, column] = value(q[:, column]) if callable(value) else value
    return replace(x, q=q, qd=np.gradient(q, x.t, axis=0), mapping=LogMapping(input="position"))


def test_positions_that_stay_while_commands_move_are_an_error(arm, logs):
    constant = [only_rows(x, 1, slice(None), 0.1) for x in logs]
    assert "joint 'elbow': got q always 0.1 while its command goes from" in str(
        spelgen.check_logs(constant, arm).errors[0]
    )
    stalled = [only_rows(logs[0], 1, slice(200, 350), lambda q: q[200])]
    (error,) = map(str, spelgen.check_logs(stalled, arm).errors)
    assert "q that stays at" in error and "write 'dropouts: dropped'" in error


def test_outliers_of_commands_are_named_and_jumps_of_commands_are_not(arm, logs):
    far = changed(logs[:1], u=lambda x: x.u + 3.0 * (np.arange(len(x.u)) == 300)[:, None])
    (error,) = map(str, spelgen.check_logs(far, arm).errors)
    assert "u that deviates from its neighbours by" in error and "in 1 sample, at t = 6 s" in error
    assert not spelgen.check_logs(logs, arm).errors


@pytest.mark.parametrize("unit", ["turns", "mrad", "deg"])
def test_encoder_steps_show_the_unit_of_positions(arm, logs, unit):
    factor = {"turns": 1 / (2 * np.pi), "mrad": 1000.0, "deg": 180 / np.pi}[unit]
    scaled = changed(logs, q=lambda x: factor * x.q, u=lambda x: factor * x.u)
    error = str(spelgen.check_logs(scaled, arm).errors[0])
    assert f"write 'units: {{q: {unit}}}'" in error or (unit == "mrad" and "more than two turns" in error)


def test_whole_numbers_without_velocities_are_not_called_degrees(arm, logs):
    position = LogMapping(input="position")
    rounded = {
        name: lambda x, name=name: np.round(getattr(x, name) * 4096 / (2 * np.pi)) for name in ("q", "u")
    }
    counts = changed(changed(logs, **rounded), mapping=lambda x: position)
    (error,) = map(str, spelgen.check_logs(counts, arm).errors)
    assert "counts of an encoder need 'counts_per_turn'" in error and "q: deg" not in error


def test_commands_that_are_later_positions_are_reported(arm, logs):
    shifted = changed(logs, u=lambda x: np.concatenate([x.q[1:], x.q[-1:]]))
    (finding,) = (x for x in spelgen.check_logs(shifted, arm).findings if x.code == "commands-are-positions")
    assert "u is q, 1 row later" in finding.message and finding.where == "joint 'shoulder', 'elbow'"


def test_periodic_commands_are_no_increments_and_have_no_opposite_sense(arm):
    t = np.arange(1000) * 0.02
    u = 0.04 * np.sign(np.sin(2 * np.pi * 1.7 * t)) * np.ones((2, 1))
    q = np.stack([0.03 * np.sin(2 * np.pi * 1.7 * (t - 0.08) - 0.5)] * 2, axis=1)
    log = Trajectory(t, q, np.gradient(q, t, axis=0), np.zeros((len(t), 0)), u=u.T)
    assert not spelgen.check_logs([log], arm).errors


def test_a_joint_at_rest_in_one_of_several_recordings_has_no_other_unit(arm, logs):
    """Dry friction holds a joint whose command changes by 1 degree. Positions without velocities have no wrong ones."""
    u, q = logs[0].u.copy(), logs[0].q.copy()
    u[:, 1], q[:, 1] = 0.3 + 0.02 * (u[:, 1] - u[:, 1].mean()), 0.3 + 0.004 * (q[:, 1] - q[:, 1].mean())
    held = replace(logs[0], u=u, q=q, mapping=LogMapping(input="position", velocity="differentiated"))
    found = spelgen.check_logs([held, *logs[1:]], arm)
    assert not found.errors and "velocity-is-no-derivative" not in codes(found)


def opposite(log, k):
    sign = 1.0 - 2.0 * (np.arange(2) == k)
    return replace(log, q=log.q * sign, qd=log.qd * sign, u=log.u * sign)


@pytest.mark.parametrize("seed", range(3))
def test_position_errors_show_senses_and_order_of_servos(arm, seed):
    """Joints with the opposite sign, or in the wrong order, are found in logs of servos without torques.

    The position error u - q of a servo is proportional to its torque, and its gravity part shows both faults.
    """
    logs = [replace(x, mapping=LogMapping(input="position")) for x in servo_logs(1, 20.0, seed=seed)]
    assert not spelgen.check_logs(logs, arm).errors
    (error,) = map(str, spelgen.check_logs([opposite(x, 1) for x in logs], arm).errors)
    # Gravity torques of this arm are the same if both joints are reversed. They determine the sense of one joint
    # relative to the other, but not which joint is reversed.
    assert "elbow: {sign: -1}" in error and "--accept joint-sense" in error
    exchanged = changed(logs, q=lambda x: x.q[:, ::-1], qd=lambda x: x.qd[:, ::-1], u=lambda x: x.u[:, ::-1])
    (error,) = map(str, spelgen.check_logs(exchanged, arm).errors)
    assert "shoulder: {columns: {q: q_elbow, u: u_elbow}}" in error
