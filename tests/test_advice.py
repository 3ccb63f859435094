"""Messages about faults of logs advise lines of the settings file; a file with these lines corrects the fault.

The advised lines about jumps, dropouts, held samples, geometry, clipped torques, couplings, calibrations and times in
another unit are not tested here, but in the test modules of these checks.
"""

import re
from dataclasses import replace

import numpy as np
import pyarrow as pa
import pytest
import yaml
from servo_arm import servo_logs, write_servo_arm
from test_log_geometry import pick_and_place, recorded

from spelgen.arm.configured_arm import load_arm
from spelgen.errors import SpelgenError
from spelgen.log_checks.check_logs import check_logs
from spelgen.logs.jumps import is_interrupted
from spelgen.logs.read import read_logs, write_logs
from spelgen.logs.recording import stale_rows
from spelgen.logs.trajectory import Trajectory
from spelgen.settings.log_mapping import SCALES


@pytest.fixture(params=["rpr", "ur10e"])
def arm(request, robots, tmp_path):
    text = (robots / f"{request.param}.urdf").read_text()
    (tmp_path / "arm.urdf").write_text(re.sub(r'effort="[^"]*"', 'effort="0"', text))
    return load_arm(tmp_path / "arm.urdf")


def logged(arm, trajectory, columns=None, **scaled):
    """Write a trajectory as a CSV log; return its path.

    scaled: factors of quantities, such as tau=0.02. columns: function that returns the names of the columns to keep,
    from the names of all columns; None: all are kept.
    """
    path = arm.robot.path.with_name("log.csv")
    changed = replace(trajectory, **{name: getattr(trajectory, name) * x for name, x in scaled.items()})
    write_logs(path, [changed], arm)
    table = pa.csv.read_csv(path)
    pa.csv.write_csv(table if columns is None else table.select(columns(table.column_names)), path)
    return path


def message_of(arm, path) -> str:
    """Return the errors about a log as text, or its warnings if it has no errors; "" if it has neither."""
    try:
        report = check_logs(read_logs([path], arm), arm)
    except SpelgenError as error:
        return str(error)
    return "\n".join(map(str, report.errors or report.warnings))


def obeyed(arm, message: str):
    """Return the arm with all lines that a message advises written into its settings."""
    lines = re.findall(
        r"write '(.*?)' (?:or a 'gain' )?((?:under 'logs' )?)in", message.replace("into", "in")
    )
    assert lines, message
    settings: dict = {}
    for line, under_logs in dict.fromkeys(lines):
        group = settings.setdefault("logs", {}) if under_logs else settings
        for key, value in yaml.safe_load(f"{{{line}}}").items():
            group[key] = {**group[key], **value} if isinstance(value, dict) and key in group else value
    arm.robot.path.with_suffix(".yaml").write_text(yaml.safe_dump(settings))
    return load_arm(arm.robot.path)


@pytest.mark.parametrize(
    ("arm", "part"), [("rpr", 0.0), ("rpr", -0.12), ("rpr", 0.2), ("ur10e", -0.12)], indirect=["arm"]
)
def test_gravity_of_compensated_torques(arm, part):
    path = logged(arm, recorded(arm, 5, gravity=part))
    message = message_of(arm, path)
    assert "gravity is compensated" in message
    assert "gravity" not in message_of(obeyed(arm, message), path)


@pytest.mark.parametrize(
    ("arm", "factor"), [("rpr", 1 / 0.003), ("rpr", 0.02), ("ur10e", 0.02)], indirect=["arm"]
)
def test_gain_of_torques_in_another_unit(arm, factor):
    path = logged(arm, recorded(arm, 6), tau=factor)
    message = message_of(arm, path)
    assert "torques of another unit" in message
    assert "torque" not in message_of(obeyed(arm, message), path)


@pytest.mark.parametrize("arm", ["rpr", "ur10e"], indirect=True)
def test_gain_of_torques_in_another_unit_and_of_the_opposite_sense(arm):
    """The settings line that is advised first corrects the sense of the torques.

    With this line, the check of the same log may report a wrong unit: a second advised line then corrects the unit.
    """
    path = logged(arm, recorded(arm, 6), tau=-0.02)
    message = message_of(arm, path)
    assert "of the opposite sense" in message
    arm = obeyed(arm, message)
    message = message_of(arm, path)
    if "torque" in message:
        assert "torques of another unit" in message
        arm = obeyed(arm, message)
    assert "torque" not in message_of(arm, path)


@pytest.mark.parametrize("arm", ["rpr"], indirect=True)
@pytest.mark.parametrize("turn", [2 * np.pi, -2 * np.pi])
def test_offset_of_angles_of_another_turn(arm, turn):
    """If angles are logged one revolution beyond the limits of a joint, the advised offset corrects them."""

    def within_limits(arm, rng):
        t, q = pick_and_place(arm, rng)
        return t, q * [1.0, 0.3, 1.0] + [0.0, 0.8, 0.0]

    log = recorded(arm, 5, within_limits)
    path = logged(arm, replace(log, q=log.q + turn * np.eye(3)[2]))
    message = message_of(arm, path)
    assert "another turn" in message and "offset: " in message
    assert message_of(obeyed(arm, message), path) == ""


@pytest.mark.parametrize("arm", ["rpr"], indirect=True)
def test_angles_beyond_both_limits_are_of_no_other_turn(arm):
    """If the angles of a joint span more than the range of its limits, the message advises no offset of the zero.

    No offset would shift all angles into the range.
    """

    def wide(arm, rng):
        t, q = pick_and_place(arm, rng)
        return t, q * [1.0, 0.3, 8.0 / np.ptp(q[:, 2])] + [0.0, 0.8, 0.0]

    message = message_of(arm, logged(arm, recorded(arm, 5, wide)))
    assert "the limit is" in message and "another turn" not in message and "offset" not in message


def test_joints_that_were_not_logged(arm):
    last = arm.chain.joint_names[-1]
    path = logged(arm, recorded(arm, 7), lambda names: [x for x in names if not x.endswith(f"_{last}")])
    message = message_of(arm, path)
    assert f"nothing was logged of {last}" in message
    changed = obeyed(arm, message)
    assert changed.chain.joint_names == arm.chain.joint_names[:-1]
    (log,) = read_logs([path], changed)
    assert log.q.shape[1] == len(arm.chain.joint_names) - 1


def test_velocities_that_were_not_logged(arm):
    log = recorded(arm, 8)
    path = logged(arm, log, lambda names: [x for x in names if not x.startswith("qd_")])
    changed = obeyed(arm, message_of(arm, path))
    (read,) = read_logs([path], changed)
    np.testing.assert_allclose(read.qd, log.qd, atol=0.02 * np.abs(log.qd).max())
    assert "qd" not in message_of(changed, path)


def test_commands_of_position_servos(arm):
    log = recorded(arm, 9)
    servo = Trajectory(log.t, log.q, log.qd, np.zeros((len(log), 0)), "servo", u=np.roll(log.q, -3, axis=0))
    path = logged(arm, servo, lambda names: [x for x in names if not x.startswith("qd_")])
    message = message_of(arm, path)
    assert "write 'input: position'" in message
    (read,) = read_logs([path], obeyed(arm, message))
    np.testing.assert_allclose(read.u, servo.u)


def test_gain_of_motor_currents(arm):
    """Currents with a gain of 1 in the settings are reported; other gains and gains that a fit trains are not."""
    names, path = arm.chain.joint_names, logged(arm, recorded(arm, 11), tau=0.5)
    settings = arm.robot.path.with_suffix(".yaml")

    def warned(gain, drives=""):
        joints = ", ".join(f"{name}: {{gain: {gain}}}" for name in names)
        settings.write_text(f"logs: {{units: {{tau: A}}, joints: {{{joints}}}}}\n{drives}")
        return "currents or parts of a torque with a gain of 1" in message_of(load_arm(arm.robot.path), path)

    assert warned(1.0) and not message_of(load_arm(arm.robot.path), path).startswith("joint")
    assert not warned(2.0)
    trained = ", ".join(f"{name}: {{gain: trained, gear: 1}}" for name in names)
    assert not warned(1.0, f"torque: motor\njoints: {{{trained}}}\n")


UNITS = {
    "degrees": ("deg", "deg/s"),
    "degrees and rad/s": ("deg", None),
    "rpm": (None, "rpm"),
    "degrees and rpm": ("deg", "rpm"),
    "revolutions and rad/s": ("turns", None),
    "revolutions": ("turns", "turns/s"),
}


@pytest.mark.parametrize(
    ("arm", "units", "single"),
    [
        *(("rpr", units, False) for units in UNITS), ("ur10e", "revolutions", False),
        ("ur10e", "degrees and rpm", False), ("ur10e", "degrees", True), ("ur10e", "rpm", True),
    ],
    indirect=["arm"],
)  # fmt: skip
def test_units_of_positions_and_velocities(arm, units, single):
    """If positions and velocities are in another unit, the message advises one settings line, which corrects them.

    This holds if all revolute joints are logged in the other unit, and if only one is (`single`).
    """
    log, turning = recorded(arm, 12), [x.joint_type == "revolute" for x in arm.chain.coordinates]
    changed = np.flatnonzero(turning)[-2:-1] if single else np.array(turning)
    q, qd = (1 / SCALES.get(unit, 1.0) for unit in UNITS[units])
    columns = {"q": log.q.copy(), "qd": log.qd.copy()}
    columns["q"][:, changed] *= q
    columns["qd"][:, changed] *= qd
    path = logged(arm, replace(log, **columns))
    message = message_of(arm, path)
    assert message.count("write '") == 1, message
    mended = obeyed(arm, message)
    (read,) = read_logs([path], mended)
    np.testing.assert_allclose(read.q, log.q, atol=1e-9)
    np.testing.assert_allclose(read.qd, log.qd, atol=1e-9)
    assert "units" not in message_of(mended, path)


COLUMNS = {
    "exchanged quantities": lambda log: {"q": log.qd, "qd": log.q},
    "order of velocities": lambda log: {"qd": np.roll(log.qd, 1, axis=1)},
    "order of positions and velocities": lambda log: {
        "q": np.roll(log.q, 1, axis=1),
        "qd": np.roll(log.qd, 1, axis=1),
    },
}


@pytest.mark.parametrize(
    ("arm", "wrong"),
    [*(("rpr", wrong) for wrong in COLUMNS), ("ur10e", "exchanged quantities")],
    indirect=["arm"],
)
def test_columns_of_positions_and_velocities(arm, wrong):
    log = recorded(arm, 13)
    path = logged(arm, replace(log, **COLUMNS[wrong](log)))
    mended = obeyed(arm, message_of(arm, path))
    (read,) = read_logs([path], mended)
    np.testing.assert_allclose(read.q, log.q, atol=1e-9)
    np.testing.assert_allclose(read.qd, log.qd, atol=1e-9)
    assert "write" not in message_of(mended, path)


@pytest.mark.parametrize(
    ("arm", "quantity"), [("rpr", "q"), ("rpr", "qd"), ("rpr", "tau"), ("ur10e", "tau")], indirect=["arm"]
)
def test_values_that_stay_while_the_joint_moves(arm, quantity):
    log = recorded(arm, 14)
    values = getattr(log, quantity).copy()
    values[800:1100, 1] = values[800, 1]
    path = logged(arm, replace(log, **{quantity: values}))
    message = message_of(arm, path)
    assert f"{quantity} that stays at" in message and "in 299 samples from t = 8.01 s" in message
    (read,) = read_logs([path], obeyed(arm, message))
    assert len(read) == len(log) - 299 and not np.isin(read.t, log.t[801:1100]).any()


@pytest.mark.parametrize("arm", ["rpr"], indirect=True)
def test_values_that_stay_in_most_of_a_recording_are_not_dropped(arm):
    log = recorded(arm, 14)
    tau = log.tau.copy()
    tau[: 3 * len(log) // 4, 1] = tau[0, 1]
    message = message_of(arm, logged(arm, replace(log, tau=tau)))
    assert "tau that stays at" in message and "dropouts" not in message


@pytest.mark.parametrize("arm", ["rpr", "ur10e"], indirect=True)
@pytest.mark.parametrize("quantity", ["q", "tau"])
@pytest.mark.parametrize("last", [1200, 2001])
def test_values_that_stay_are_found_without_velocities_and_until_the_end(arm, quantity, last):
    """A position that stays shows no velocity; its motion before and after does. last: first sample after the stay."""
    log = recorded(arm, 14)
    values = getattr(log, quantity).copy()
    start = 800 + int(np.argmax(np.abs(log.qd[800:1000, 1])))
    values[start:last, 1] = values[start, 1]
    wrong = replace(log, **{quantity: values})
    path = logged(arm, wrong, lambda names: [x for x in names if not x.startswith("qd_")])
    arm.robot.path.with_suffix(".yaml").write_text("logs: {velocity: differentiated}\n")
    message = message_of(load_arm(arm.robot.path), path)
    end = min(last, len(log))
    assert f"{quantity} that stays at" in message and f"in {end - start - 1} samples" in message


def test_an_outlier_of_a_position_is_no_motion():
    """Velocities and torques of a joint at rest are not stale because one of its positions was lost."""
    t = 0.02 * np.arange(1000)
    q, qd = np.full(1000, 0.4), np.zeros(1000)
    q[800:], qd[800:] = 0.4 + np.sin(t[:200]), np.cos(t[:200])
    q[40] = -3.14
    tau = np.where(t < t[800], 2.0, 5.0 * np.cos(3.0 * t))
    assert not stale_rows("qd", qd, t, q, qd, np.zeros(0)).any()
    assert not stale_rows("tau", tau, t, q, np.zeros(0), np.zeros(0)).any()


@pytest.mark.parametrize("ramp", [1, 3])
def test_joints_that_rest_between_motions_and_at_the_end_are_not_interrupted(ramp):
    """The speed changes within `ramp` samples: slowly sampled arms, and simulated ones, stop within a sample."""
    speed = np.tile(np.repeat([1.0, 0.0, -0.5, 0.0], 60), 3)
    speed = np.convolve(speed, np.ones(ramp) / ramp, mode="valid")
    t = 0.1 * np.arange(len(speed))
    assert not is_interrupted(t, 0.1 * np.cumsum(speed)).any()
    # another recording follows, from another position
    joined = np.append(0.1 * np.cumsum(speed), 0.1 * np.cumsum(speed) + 8.0)
    assert not is_interrupted(0.1 * np.arange(len(joined)), joined).any()


@pytest.mark.parametrize("arm", ["rpr"], indirect=True)
def test_velocities_that_are_refreshed_rarely(arm):
    log = recorded(arm, 15)
    path = logged(arm, replace(log, qd=log.qd[np.arange(len(log)) // 10 * 10]))
    mended = obeyed(arm, message_of(arm, path))
    (read,) = read_logs([path], mended)
    np.testing.assert_allclose(read.qd[5:-5], log.qd[5:-5], atol=0.02 * np.abs(log.qd).max())
    assert "qd" not in message_of(mended, path)


@pytest.mark.parametrize("unit", ["{q: rad, u: deg}", "{q: deg, u: rad}"])
def test_unit_of_commands_and_positions_of_servos(tmp_path, unit):
    arm = load_arm(write_servo_arm(tmp_path, "input: position\njoints: {shoulder: {kp: 14.0}}\n"))
    right, factors = servo_logs(1, 12.0), {x: 180 / np.pi for x in ("q", "u") if f"{x}: deg" in unit}
    scaled = [replace(x, **{name: getattr(x, name) * f for name, f in factors.items()}) for x in right]
    path = write_logs(tmp_path / "log.parquet", scaled, arm)
    pa.parquet.write_table(pa.parquet.read_table(path).replace_schema_metadata(None), path)
    settings = arm.robot.path.with_suffix(".yaml")
    message = message_of(arm, path)
    assert message.count(f"write 'units: {unit}'") == 1
    settings.write_text(f"{settings.read_text()}logs: {{units: {unit}}}\n")
    mended = load_arm(arm.robot.path)
    (read,) = read_logs([path], mended)
    np.testing.assert_allclose(read.u, right[0].u)
    assert message_of(mended, path) == ""


def test_column_of_commands_that_another_joint_follows(tmp_path):
    arm = load_arm(write_servo_arm(tmp_path, "input: position\njoints: {shoulder: {kp: 14.0}}\n"))
    path = write_logs(tmp_path / "log.csv", [replace(x, u=x.u[:, ::-1]) for x in servo_logs(1, 12.0)], arm)
    message = message_of(arm, path)
    assert "columns: {u: u_elbow}" in message and "columns: {u: u_shoulder}" in message
    settings = arm.robot.path.with_suffix(".yaml")
    columns = "shoulder: {columns: {u: u_elbow}}, elbow: {columns: {u: u_shoulder}}"
    settings.write_text(f"{settings.read_text()}logs: {{joints: {{{columns}}}}}\n")
    assert message_of(load_arm(arm.robot.path), path) == ""


@pytest.mark.parametrize(
    ("line", "factor"),
    [
        ("units: {tau: mNm}", 1e3),
        ("joints: {%s: {gain: 0.001}, %s: {gain: 0.001}}", 1e3),
        ("units: {tau: Nm}", 1e3),
    ],
)
def test_unit_of_torques_beyond_the_drive(robots, tmp_path, line, factor):
    """On an arm without gravity torques, torques in mNm are reported because they exceed 20 times the effort limit.

    A settings line with this unit or with a gain corrects them. The line "units: {tau: Nm}" confirms them as Nm.
    """
    text = (robots / "scara.urdf").read_text()
    (tmp_path / "arm.urdf").write_text(re.sub(r'effort="[^"]*"', 'effort="100"', text))
    arm = load_arm(tmp_path / "arm.urdf", joints=load_arm(robots / "scara.urdf").chain.joint_names[:2])
    log = recorded(arm, 10)
    path = logged(arm, log, tau=factor)
    message = message_of(arm, path)
    assert "what the drive can give" in message and message.count("write '") == 1
    names = arm.chain.joint_names
    arm.robot.path.with_suffix(".yaml").write_text(f"logs: {{{line % names if '%' in line else line}}}\n")
    mended = load_arm(arm.robot.path, joints=names)
    (read,) = read_logs([path], mended)
    np.testing.assert_allclose(
        read.tau, log.tau * (factor if line.endswith("Nm}") and "mNm" not in line else 1.0)
    )
    assert "what the drive can give" not in message_of(mended, path)
