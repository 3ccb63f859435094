"""The lines that messages about logs advise are written into the settings, and the log is then read and right.

Lines for jumps, dropouts, held samples, geometry, clipped torques, couplings, calibrations and times in another unit
are applied in the tests of these checks.
"""

import re
from dataclasses import replace

import numpy as np
import pyarrow as pa
import pytest
import yaml
from test_log_geometry import recorded

from spelgen.arm.configured_arm import load_arm
from spelgen.errors import SpelgenError
from spelgen.log_checks.check_logs import check_logs
from spelgen.logs.read import read_logs, write_logs
from spelgen.logs.trajectory import Trajectory


@pytest.fixture(params=["rpr", "ur10e"])
def arm(request, robots, tmp_path):
    text = (robots / f"{request.param}.urdf").read_text()
    (tmp_path / "arm.urdf").write_text(re.sub(r'effort="[^"]*"', 'effort="0"', text))
    return load_arm(tmp_path / "arm.urdf")


def logged(arm, trajectory, columns=None, **scaled):
    """Write a log as CSV: of only these columns if given, others multiplied by factors of their quantity."""
    path = arm.robot.path.with_name("log.csv")
    changed = replace(trajectory, **{name: getattr(trajectory, name) * x for name, x in scaled.items()})
    write_logs(path, [changed], arm)
    table = pa.csv.read_csv(path)
    pa.csv.write_csv(table if columns is None else table.select(columns(table.column_names)), path)
    return path


def message_of(arm, path) -> str:
    """Return the errors about a log, and else its warnings, as text; "" without any."""
    try:
        report = check_logs(read_logs([path], arm), arm)
    except SpelgenError as error:
        return str(error)
    return "\n".join(map(str, report.errors or report.warnings))


def obeyed(arm, message: str):
    """Return the arm with all lines that a message advises in its settings, once each."""
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


@pytest.mark.parametrize("part", [0.0, -0.12, 0.2])
def test_gravity_of_compensated_torques(arm, part):
    path = logged(arm, recorded(arm, 5, gravity=part))
    message = message_of(arm, path)
    assert "gravity is compensated" in message
    assert "gravity" not in message_of(obeyed(arm, message), path)


@pytest.mark.parametrize("factor", [1 / 0.003, 0.02])
def test_gain_of_torques_in_another_unit(arm, factor):
    path = logged(arm, recorded(arm, 6), tau=factor)
    message = message_of(arm, path)
    assert "torques of another unit" in message
    assert "torque" not in message_of(obeyed(arm, message), path)


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
    """A draft states the gain 1 for currents; the gains of a fit (gain: trained) need none."""
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


def test_unit_of_torques_beyond_the_drive(robots, tmp_path):
    """Of a planar arm without gravity: only the drive's limit shows the unit."""
    text = (robots / "scara.urdf").read_text()
    (tmp_path / "arm.urdf").write_text(re.sub(r'effort="[^"]*"', 'effort="100"', text))
    arm = load_arm(tmp_path / "arm.urdf", joints=load_arm(robots / "scara.urdf").chain.joint_names[:2])
    log = recorded(arm, 10)
    message = message_of(arm, logged(arm, log, tau=1e3))
    assert "what the drive can give" in message
    units = arm.robot.path.with_suffix(".yaml")
    units.write_text("logs: {units: {tau: mNm}}\n")
    mended = load_arm(arm.robot.path, joints=arm.chain.joint_names)
    assert "what the drive can give" not in message_of(mended, logged(arm, log, tau=1e3))
