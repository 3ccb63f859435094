"""If one of several recordings has a fault, the error names this recording.

A settings line would apply to all recordings: the error advises none, or one for the case that all have the fault.
"""

from dataclasses import replace

import numpy as np
import pytest
from servo_arm import servo_logs, write_servo_arm
from test_log_geometry import arm, recorded  # noqa: F401
from typer.testing import CliRunner

import spelgen
from spelgen.cli.main import app
from spelgen.log_checks.check_logs import check_logs

OF_ONE = "the other recordings do not have this fault: correct this one, or omit it"


def reversed_joint(log, k, quantities):
    sign = 1.0 - 2.0 * (np.arange(log.q.shape[1]) == k)
    return replace(log, **{name: getattr(log, name) * sign for name in quantities})


FAULTS = {
    "joint-sense": lambda log: reversed_joint(log, 1, ("q", "qd")),
    "torque-sense": lambda log: reversed_joint(log, 1, ("tau",)),
    "torque-unit": lambda log: replace(log, tau=1000 * log.tau),
}


@pytest.fixture(scope="module")
def recordings(arm):  # noqa: F811
    """Return four recordings without faults."""
    logs = [replace(recorded(arm, 10 + k), name=f"run {k}") for k in range(4)]
    assert check_logs(logs, arm).errors == ()
    return logs


@pytest.mark.parametrize("arm", ["six_dof"], indirect=True)
@pytest.mark.parametrize("code", FAULTS)
def test_the_recording_whose_torques_contradict_the_others_is_named(arm, recordings, code):  # noqa: F811
    logs = [*recordings[:2], FAULTS[code](recordings[2]), recordings[3]]
    (error,) = map(str, check_logs(logs, arm).errors)
    assert "trajectory run 2, " in error and OF_ONE in error and f"--accept {code}" not in error
    assert "write '" not in error


@pytest.mark.parametrize("arm", ["six_dof"], indirect=True)
@pytest.mark.parametrize("code", FAULTS)
@pytest.mark.parametrize("wrong", [0, 1])
def test_of_two_recordings_that_contradict_each_other_the_wrong_one_is_named(arm, recordings, code, wrong):  # noqa: F811
    logs = recordings[:2]
    logs[wrong] = FAULTS[code](logs[wrong])
    (error,) = map(str, check_logs(logs, arm).errors)
    assert f"trajectory run {wrong}, " in error and OF_ONE in error and "write '" not in error


@pytest.mark.parametrize("arm", ["six_dof"], indirect=True)
def test_a_fault_of_both_of_two_recordings_has_lines(arm, recordings):  # noqa: F811
    logs = [FAULTS["joint-sense"](log) for log in recordings[:2]]
    (error,) = map(str, check_logs(logs, arm).errors)
    assert "trajectory" not in error and "sign: -1" in error


@pytest.mark.parametrize("arm", ["six_dof"], indirect=True)
@pytest.mark.parametrize("count", [2, 4])
def test_a_torque_of_another_scale_in_one_recording_is_named(arm, recordings, count):  # noqa: F811
    log = recordings[0]
    rows = np.array_split(np.arange(len(log)), count)
    logs = [
        replace(log, name=f"run {k}", t=log.t[x] - log.t[x[0]], q=log.q[x], qd=log.qd[x], tau=log.tau[x])
        for k, x in enumerate(rows)
    ]
    assert check_logs(logs, arm).errors == ()
    logs[1] = replace(logs[1], tau=logs[1].tau * np.array([1, 1.6, 1, 1, 1, 1]))
    (error,) = map(str, check_logs(logs, arm).errors)
    assert (
        "trajectory run 1, joint 'joint2', tau" in error
        and "1.6 times those of the other recordings" in error
    )


SERVO_FAULTS = {
    "move against commands": lambda log: replace(log, u=log.u * [1, -1]),
    "commands that other joints follow": lambda log: replace(log, u=log.u[:, ::-1]),
    "above the positions throughout": lambda log: replace(log, u=log.u + np.array([0, 1.0])),
    "positions in rad": lambda log: replace(log, q=np.radians(log.q), u=np.radians(log.u)),
}


@pytest.fixture(scope="module")
def servos(tmp_path_factory):
    folder = tmp_path_factory.mktemp("servos")
    return spelgen.load_arm(write_servo_arm(folder, "input: position\nlogs: {units: {q: deg}}\n"))


@pytest.fixture(scope="module")
def servo_recordings(servos):
    """Return four recordings of servos without faults."""
    logs = [replace(x, mapping=servos.settings.logs) for x in servo_logs(4, 12.0)]
    assert check_logs(logs, servos).errors == ()
    return logs


@pytest.mark.parametrize("text", SERVO_FAULTS)
def test_the_recording_of_servos_with_a_fault_is_named(servos, servo_recordings, text):
    first, second, *others = servo_recordings
    logs = [first, SERVO_FAULTS[text](second), *others]
    errors = list(map(str, check_logs(logs, servos).errors))
    assert len(errors) == 1 and text in errors[0]
    assert "trajectory motion 1" in errors[0] and OF_ONE in errors[0] and "write '" not in errors[0]


def test_a_unit_of_one_recording_is_no_advice_for_all(tmp_path):
    servos = spelgen.load_arm(write_servo_arm(tmp_path))
    logs = servo_logs(3, 12.0)
    logs[1] = replace(logs[1], q=np.degrees(logs[1].q), qd=np.degrees(logs[1].qd), u=np.degrees(logs[1].u))
    (error,) = map(str, check_logs(logs, servos).errors)
    assert "trajectory motion 1" in error
    assert "if this is true of all recordings; else correct this one, or omit it" in error


def test_a_fault_of_both_recordings_is_sought_in_both_together(shared):
    """Of two recordings with a mirrored joint, one alone would also show a false delay of another joint."""
    case = shared / "cases" / "30-sign-of-joint"
    given = ["--robot", str(case / "elfin15.urdf"), "--mapping", str(case / "elfin_map2.yaml")]
    result = CliRunner().invoke(app, ["logs", str(case / "logs"), *given])
    assert result.exit_code == 1
    assert "write 'joints: {elfin_joint3: {sign: -1}}' under 'logs'" in result.output
