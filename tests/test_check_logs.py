"""`spelgen logs` reports the properties that simulated logs have, and finds each inserted fault."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from html_page import Page
from scipy.integrate import cumulative_trapezoid
from typer.testing import CliRunner

from spelgen.arm.actuation import Drives
from spelgen.arm.configured_arm import load_arm
from spelgen.cli.main import app
from spelgen.dynamics.regressor_dynamics import body_chain, regressor, urdf_parameters
from spelgen.errors import LogError, SpelgenError
from spelgen.identification import motion_samples
from spelgen.identification.drive_hints import drive_problem, find_coupling
from spelgen.identification.identify import identify
from spelgen.identification.motion_samples import DriveLog
from spelgen.log_checks import check_torque_logs, robot_checks
from spelgen.log_checks.check_logs import check_logs, require_sound_logs
from spelgen.log_checks.statistics import noise_level, quantisation_step, statistics
from spelgen.logs import checks, read, segments
from spelgen.logs.dynamics_samples import dynamics_samples
from spelgen.logs.preprocessing import Preprocessing
from spelgen.logs.read import read_logs, write_logs
from spelgen.logs.trajectory import Trajectory
from spelgen.logs.windows import split_validation
from spelgen.render.arm_pages import logs_page
from spelgen.settings.log_mapping import LogMapping


@pytest.fixture(scope="module")
def loaded(robots):
    """Return the arm rpr with a revolute, a prismatic and a revolute joint; gravity loads joint 3 most."""
    return load_arm(robots / "rpr.urdf")


@pytest.fixture(scope="module")
def arm(loaded):
    return loaded.chain


@pytest.fixture(scope="module")
def log(arm) -> Trajectory:
    """Return a log of 20 s of smooth motion within the limits, at 100 Hz with a jitter of the times.

    Its torques are torques of the URDF's rigid bodies plus viscous and dry friction.
    """
    random = np.random.default_rng(0)
    t = np.cumsum(0.01 * (1 + 0.1 * random.uniform(-1, 1, 2000)))
    middle, width, speed = np.array([0.0, 0.8, 0.2]), np.array([0.5, 0.2, 0.8]), np.array([0.5, 0.7, 1.1])
    phase = t[:, None] * speed
    q, qd = middle + width * np.sin(phase), width * speed * np.cos(phase)
    tau = regressor(arm, q, qd, -width * speed**2 * np.sin(phase)) @ urdf_parameters(arm)
    return Trajectory(t, q, qd, tau + 0.4 * qd + 0.3 * np.sign(qd), "motion")


class Geared:
    """Actuation of an arm that has the same gear at each joint."""

    def __init__(self, gear):
        self.gear = gear

    def matrix(self):
        return self.gear * np.eye(3)

    def drives(self):
        return Drives(self.matrix(), np.eye(3))


def test_a_sound_log_has_its_figures_and_no_findings(loaded, arm, log):
    again = replace(log, name="again", t=log.t + 3, tau=1.001 * log.tau)
    result = check_logs([log, again], loaded)
    assert (result.samples, result.findings, result.errors) == (4000, (), ())
    assert result.duration == pytest.approx(40, rel=0.01)
    clock = result.trajectories[0]
    assert clock.sample_rate == pytest.approx(100, rel=0.01)
    assert clock.jitter == pytest.approx(0.1 / np.sqrt(3), rel=0.05)
    for index, joint in enumerate(result.joints):
        assert joint.low["q"] == log.q[:, index].min()
        assert joint.velocity_factor == pytest.approx(1, abs=1e-3)
    loaded = [joint for joint in result.joints if (joint.gravity.relative_deviation or 0) > 0.2]
    assert loaded
    for joint in loaded:
        assert joint.gravity.factor == pytest.approx(1, abs=0.1)
        assert joint.gravity.explained > 0.9
    assert "No findings." in result.text()


def test_motor_torques_are_taken_to_the_joints(loaded, arm, log):
    motors = replace(log, tau=log.tau / 50)
    result = check_logs([motors], replace(loaded, actuation=Geared(50)))
    assert [x.gravity.factor for x in result.joints] == pytest.approx(
        [x.gravity.factor for x in check_logs([log], loaded).joints]
    )


@pytest.fixture(scope="module")
def loaded_joint(loaded, log) -> int:
    """Return the index of the joint with the largest gravity torques. The log is checked once per test module."""
    joints = check_logs([log], loaded).joints
    return max(range(3), key=lambda k: joints[k].gravity.relative_deviation or 0)


@pytest.mark.parametrize("code", ["torque-without-gravity", "torque-scale"])
def test_torques_without_gravity_or_of_another_scale_are_found(loaded, loaded_joint, arm, log, code):
    joint, tau = loaded_joint, log.tau.copy()
    still = np.zeros_like(log.q)
    gravity = regressor(arm, log.q, still, still) @ urdf_parameters(arm)
    random = np.random.default_rng(1)
    tau[:, joint] = {
        "torque-without-gravity": (tau - gravity)[:, joint] + 0.1 * random.standard_normal(len(tau)),
        "torque-scale": tau[:, joint] / 8,
    }[code]
    findings = check_logs([replace(log, tau=tau)], loaded).findings
    # `urdf-inertials` is ignored: wrong inertials of a link would explain a wrong scale of one torque as well.
    found = [(x.severity, x.code, x.where) for x in findings if x.code != "urdf-inertials"]
    assert found == [("warning", code, f"joint {arm.coordinates[joint].name!r}")]


@pytest.mark.parametrize("noise", [0.02, 0.05])
def test_the_small_torque_of_a_free_swing_has_gravity(loaded, arm, noise):
    """Joint 3 swings nearly at its natural frequency of 9.8 rad/s: its inertial torque balances gravity.

    noise: standard deviation of the torques [Nm, N].
    """
    t = np.arange(0.0, 20.0, 0.01)
    swing = -1.5734 + 0.4 * (1 + 0.3 * np.sin(0.3 * t)) * np.sin(9.51 * t)
    q = np.stack([np.zeros_like(t), np.full_like(t, 0.15), swing], axis=1)
    qd = np.gradient(q, t, axis=0)
    tau = regressor(arm, q, qd, np.gradient(qd, t, axis=0)) @ urdf_parameters(arm) + 0.02 * np.sign(qd)
    tau += noise * np.random.default_rng(0).standard_normal(tau.shape)
    report = check_logs([Trajectory(t, q, qd, tau, "swing")], loaded)
    assert report.errors == ()
    assert report.joints[2].gravity.relative_deviation > 3 and abs(report.joints[2].gravity.correlation) < 0.3
    assert "torque-without-gravity" not in [x.code for x in report.findings]


IMPOSSIBLE = {
    "sign": (-1.0, "torques of the opposite sense", "{gain: -1}"),
    "unit": (1e-3, "torques of another unit, 0.001 times as large", "{gain: 1000}"),
    "drives": (1e4, "torques of another unit, 1e+04 times as large", "{gain: 0.0001}"),
    "both": (-1e-2, "torques of another unit and of the opposite sense, 0.01 times as large", "{gain: -100}"),
}


@pytest.mark.parametrize("case", IMPOSSIBLE)
def test_torques_of_another_sense_or_unit_are_errors_before_anything_is_fitted(
    loaded, loaded_joint, arm, log, case
):
    factor, told, line = IMPOSSIBLE[case]
    joint, tau = loaded_joint, log.tau.copy()
    tau[:, joint] *= factor
    wrong = [replace(log, tau=tau)]
    name = arm.coordinates[joint].name
    (error,) = check_logs(wrong, loaded).errors
    assert str(error).startswith(f"joint {name!r}: got {told}")
    assert f"write 'joints: {{{name}: {line}}}' under 'logs'" in str(error)
    with pytest.raises(LogError) as caught:
        require_sound_logs(wrong, loaded)
    assert str(caught.value) == str(error)
    said = LogMapping.model_validate({"units": {"tau": "Nm"}})
    assert bool(check_logs(wrong, loaded, said).errors) == (case == "sign")
    require_sound_logs([log], loaded)


def test_torques_beyond_all_drives_are_errors(loaded, arm, log):
    """Torques far beyond the effort limits are an error even if they are noise, without any gravity torque."""
    random = np.random.default_rng(0)
    coordinates = tuple(each._replace(effort=10.0) for each in arm.coordinates)
    weak = replace(loaded, chain=replace(arm, coordinates=coordinates))
    wrong = replace(log, tau=500 * random.standard_normal(log.tau.shape))
    with pytest.raises(
        LogError, match=r"times what the drive can give, expected Nm or N at the joint; write 'un"
    ):
        require_sound_logs([wrong], weak)


def test_positions_beyond_the_limits_are_reported(loaded, arm, log):
    upper = arm.coordinates[1].upper
    over = log.q.copy()
    over[:, 1] += upper + 0.01 - over[:, 1].max()
    findings = check_logs([replace(log, q=over)], loaded).findings
    told = [x.message for x in findings if x.code == "beyond-position-limit"]
    assert told == [f"q up to {upper + 0.01:.4g} m, the limit is {upper:.4g}"]


@pytest.mark.parametrize(("over", "codes"), [(1.005, set()), (1.05, {"beyond-velocity-limit"})])
def test_noise_at_the_velocity_limit_is_no_finding(loaded, arm, log, over, codes):
    first, *others = arm.coordinates
    first = first._replace(velocity=np.abs(log.qd[:, 0]).max() / over)
    slower = replace(loaded, chain=replace(arm, coordinates=(first, *others)))
    assert {x.code for x in check_logs([log], slower).findings if "velocity" in x.code} == codes


def test_noise_and_encoder_steps_are_estimated(log):
    random = np.random.default_rng(2)
    noisy = replace(log, q=log.q + 1e-3 * random.standard_normal(log.q.shape))
    np.testing.assert_allclose(statistics(noisy).signals["q"][2], 1e-3, rtol=0.1)
    assert (noise_level(log.t, log.q) < 1e-5).all()
    for step in (1e-4, 2 * np.pi / 4096):
        assert quantisation_step(np.round(log.q[:, 0] / step) * step) == pytest.approx(step, rel=1e-6)
    assert np.isnan(quantisation_step(noisy.q[:, 0]))
    assert np.isnan(quantisation_step(np.ones(100)))
    # Levels that differ only by rounding errors, as of millimetres that were converted to metres, count as one level.
    rounded = np.tile([1e-3, 1e-3 + 2e-19, 2e-3, 2e-3 + 4e-19, 4e-3, 5e-3], 20)
    assert quantisation_step(rounded) == pytest.approx(1e-3)
    assert np.isnan(statistics(log[::4]).signals["q"][2]).all()


def test_logs_that_cannot_be_trained_on_are_errors_of_a_report(loaded, arm, log):
    frozen = log.qd.copy()
    frozen[:, 0] = 0
    result = check_logs(
        [replace(log, qd=frozen, q=np.where([True, False, False], 60 * log.q, log.q))], loaded
    )
    assert [type(x).__name__ for x in result.errors] == ["LogError"] * len(result.errors)
    assert any("qd always 0 while q goes" in str(error) for error in result.errors)


def test_the_page_has_the_findings_of_the_text_and_charts_of_every_joint(loaded, arm, log):
    hostile = replace(log, name="<script>alert(1)</script>")
    result = check_logs(
        [hostile, replace(log, name="b", t=np.where(np.arange(2000) > 999, log.t + 2, log.t))], loaded
    )
    shown = Page(logs_page(result, arm, np.eye(3)))
    assert shown.links == ["data:,", "#top"]
    assert (
        shown.tags.count("svg") == 2 * 3 * 3 + 2 * 3
    )  # charts of three joints for two trajectories and three quantities, and three marks in each legend
    told = " ".join(" ".join(shown.text).split())
    assert "1 gap in time" in told and "<script>alert(1)</script>" in told
    assert "1 gap in time" in " ".join(result.text().split())


@pytest.fixture
def spelgen(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return lambda *arguments: CliRunner().invoke(app, [str(each) for each in arguments])


def test_the_command_prints_80_columns_json_and_a_page(spelgen, robots, arm, log, tmp_path):
    names = [coordinate.name for coordinate in arm.coordinates]
    write_logs(tmp_path / "logs.parquet", [log], names)
    command = ["logs", "logs.parquet", "--robot", robots / "rpr.urdf"]
    shown = spelgen(*command)
    assert shown.exit_code == 0, shown.stderr
    assert max(map(len, shown.stdout.splitlines())) <= 80
    told = json.loads(spelgen(*command, "--format", "json").stdout)
    assert (told["schema"], told["samples"], [x["name"] for x in told["joints"]]) == (3, 2000, names)
    assert spelgen(*command, "--html", "page.html").stderr == "wrote page.html\n"
    assert (tmp_path / "page.html").read_text().startswith("<!doctype html>")
    assert spelgen(*command, "--strict").exit_code == 0


def test_the_command_fails_where_logs_cannot_be_trained_on(spelgen, robots, arm, log, tmp_path):
    names = [coordinate.name for coordinate in arm.coordinates]
    still = log.qd.copy()
    still[:, 0] = 0
    write_logs(tmp_path / "logs.csv", [replace(log, qd=still)], names)
    shown = spelgen("logs", "logs.csv", "--robot", robots / "rpr.urdf")
    assert shown.exit_code == 1
    assert "Ranges" in shown.stdout
    assert shown.stderr.startswith(f"logs.csv: trajectory motion, joint '{names[0]}': got qd always 0 while")
    write_logs(tmp_path / "logs.csv", [replace(log, qd=1.3 * log.qd)], names)
    assert spelgen("logs", "logs.csv", "--robot", robots / "rpr.urdf").exit_code == 0
    strict = spelgen("logs", "logs.csv", "--robot", robots / "rpr.urdf", "--strict")
    assert (strict.exit_code, strict.stderr) == (1, "1 warning, and --strict allows none\n")


def test_settings_that_logs_do_not_need_may_have_errors(spelgen, robots, arm, log, tmp_path):
    """Logs are accepted if settings of other steps are wrong, inertials are absent, or a transmission is incomplete."""
    text = (robots / "rpr.urdf").read_text()
    text = re.sub(r"<inertial>.*?</inertial>", "", text, flags=re.DOTALL)
    odd = '<transmission name="t"><type>x/SimpleTransmission</type><joint name="joint1"/>'
    odd += (
        '<actuator name="m"><mechanicalReduction>fast</mechanicalReduction></actuator></transmission></robot>'
    )
    (tmp_path / "arm.urdf").write_text(text.replace("</robot>", odd))
    (tmp_path / "arm.yaml").write_text("training: {nonsense: 1}\nsimulation: {sample_rate: never}\n")
    write_logs(tmp_path / "logs.csv", [log], [c.name for c in arm.coordinates])
    shown = spelgen("logs", "logs.csv", "--robot", "arm.urdf")
    assert shown.exit_code == 0, shown.stderr
    assert "No findings." in shown.stdout


def test_logs_beyond_the_bound_of_memory_are_checked_by_segments(
    spelgen, robots, arm, log, tmp_path, monkeypatch
):
    """If logs exceed the memory bound, one of every k segments is kept and checked; the report states k."""
    names = [coordinate.name for coordinate in arm.coordinates]
    write_logs(tmp_path / "logs.parquet", [log], names)
    command = ["logs", "logs.parquet", "--robot", robots / "rpr.urdf", "--format", "json"]
    tuning = replace(segments.TUNING, kept_bytes=100_000, segment_samples=100)
    for module in (read, segments):
        monkeypatch.setattr(module, "TUNING", tuning)
    report = json.loads(spelgen(*command).stdout)
    (note,) = (x for x in report["findings"] if x["code"] == "subsampled")
    assert "one of 2 segments of up to 100 samples was kept, 1000 samples" in note["message"]
    assert report["samples"] == 1000


def test_the_line_for_velocities_of_the_opposite_sense_mends_them(robots, arm, log, tmp_path):
    """The error about velocities of the opposite sense advises the settings line that corrects them.

    A velocity that is only too large gets no line, since its unit or the times may be wrong.
    """
    path = tmp_path / "arm.urdf"
    path.write_bytes((robots / "rpr.urdf").read_bytes())
    write_logs(tmp_path / "log.csv", [replace(log, qd=-log.qd)], arm.joint_names)

    def wrong_velocities(qd=None):
        loaded = load_arm(path)
        logs = read_logs([tmp_path / "log.csv"], loaded) if qd is None else [replace(log, qd=qd)]
        report = check_logs(logs, loaded)
        warnings = [x.message for x in report.findings if x.code == "velocity-is-no-derivative"]
        return [*map(str, report.errors), *warnings]

    (advised,) = wrong_velocities()
    assert "joint 'joint1', 'joint2', 'joint3'" in advised and "write 'velocity: differentiated'" in advised
    assert not any("write" in x for x in wrong_velocities(1.3 * log.qd))
    path.with_suffix(".yaml").write_text("logs: {velocity: differentiated}\n")
    assert wrong_velocities() == []


@pytest.mark.parametrize("constant", [0.0, 0.1, 5.0])
def test_a_constant_torque_is_reported(loaded, log, constant):
    """A constant torque is reported even if rounding errors make its mean differ from its value, as for 0.1 Nm."""
    report = check_logs([replace(log, tau=np.full_like(log.tau, constant))], loaded)
    assert {x.code for x in report.findings} == {"constant-torque"}
    assert [x.gravity.explained for x in report.joints] == [None] * 3


def test_arrays_of_another_arm_are_refused(loaded, log):
    other = Trajectory(log.t, log.q[:, :2], log.qd[:, :2], log.tau[:, :2])
    with pytest.raises(LogError) as caught:
        check_logs([other], loaded)
    assert str(caught.value) == "trajectory trajectory: got 2 joints, expected 3: joint1, joint2, joint3"
    with pytest.raises(LogError, match="got no trajectory, expected at least one"):
        check_logs([], loaded)


def test_a_report_has_one_line_and_a_notebook_form(loaded, log):
    report = check_logs([replace(log, name="<b>", qd=-log.qd)], loaded)
    assert repr(report) == "<LogReport rpr: 1 trajectory, 19.99 s, 2000 samples; 0 warnings, 1 error>"
    shown = report._repr_html_()
    assert "&lt;b&gt;" in shown and "<b>: " not in shown
    assert shown.count("<table>") == 5
    assert json.loads(json.dumps(report.to_dict()))["files"] == 0


@pytest.mark.parametrize("registry", [checks, robot_checks])
@pytest.mark.parametrize("severity", ["info", "error"])
def test_a_new_check_is_a_function_and_its_row(loaded, log, monkeypatch, registry, severity):
    """A new check needs only a function and its `Check`, as docs/extending.md states: `spelgen logs` reports it.

    Its severity determines whether logs are refused.
    """
    check = checks.Check("odd-name", severity, lambda joint: "it is called odd", expected="another name")
    monkeypatch.setattr(registry, "CHECKS", [*registry.CHECKS, check])
    monkeypatch.setattr(check_torque_logs, "CHECKS", robot_checks.CHECKS)
    report = check_logs([log], loaded)
    if severity == "error":
        assert [error.got for error in report.errors] == ["it is called odd"]
    else:
        assert {(x.code, x.message) for x in report.findings} == {("odd-name", "it is called odd")}


@pytest.mark.parametrize("samples", [1, 2, 10, 60])
def test_a_log_too_short_for_a_fit_is_named(loaded, log, samples):
    short = log[:samples]
    with pytest.raises(LogError, match="no samples to identify from") as refused:
        identify(loaded, short)
    (message,) = [str(x) for x in check_logs(short, loaded).findings if x.code == "no-accelerations"]
    assert message.endswith(refused.value.expected)


def test_a_few_samples_give_no_figures_of_gravity(loaded, arm, log):
    result = check_logs([log[:20]], loaded)
    assert [x.gravity.explained for x in result.joints] == [None] * 3
    # one-way: within the log's fifth of a second no joint reverses
    assert {x.code for x in result.findings} == {"no-accelerations", "one-way"}


def test_logs_of_real_arms_have_no_errors(shared):
    logs = shared / "logs" / "ur10e"
    real = load_arm(logs / "ur10e.urdf")
    paths = [path for path in sorted(logs.glob("*.parquet")) if "oad" not in path.stem]
    result = check_logs(read_logs(paths, real), real)
    assert (result.errors, result.findings) == ((), ())
    assert [joint.steps["q"] for joint in result.joints] == pytest.approx([1e-4] * 6)
    assert [joint.gravity.explained > 0.9 for joint in result.joints[1:3]] == [True, True]


@pytest.mark.parametrize("name", ["20_01_13_load_2600", "20_01_31_load"])
def test_a_payload_is_not_another_unit_of_torques(shared, name):
    """The gravity torque of a payload is not mistaken for another unit of the torques.

    At wrist 2 it is 36 times the gravity torque of the URDF's wrist. The only finding allowed is the warning
    `urdf-inertials`, which advises to add the load to the last link.
    """
    folder = shared / "logs" / "ur10e"
    real = load_arm(folder / "ur10e.urdf")
    result = check_logs(read_logs([folder / f"{name}.parquet"], real), real)
    assert result.errors == ()
    assert all(x.code == "urdf-inertials" and "add the tool or load" in x.message for x in result.findings)


WRONG_TORQUES = {
    "all negated": (lambda tau: -tau, "torque-sense"),
    "first negated": (lambda tau: tau * [-1, 1, 1], "torque-sense"),
    "swapped": (lambda tau: tau[:, [0, 2, 1]], "torque-order"),
    "zero": (np.zeros_like, "no-torques"),
    "dropouts": (lambda tau: np.where(np.arange(len(tau))[:, None] % 500 == 40, 0.0, tau), "dropouts"),
}


@pytest.mark.parametrize("case", WRONG_TORQUES)
def test_impossible_torques_are_refused_unless_accepted(loaded, log, case):
    change, code = WRONG_TORQUES[case]
    wrong = replace(log, tau=change(log.tau))
    with pytest.raises(SpelgenError) as caught:
        require_sound_logs([wrong], loaded)
    assert f"--accept {code}" in str(caught.value)
    if case == "swapped":
        assert "coupl" not in str(caught.value)
    accepting = LogMapping.model_validate({"accept": [code]})
    require_sound_logs([replace(wrong, accepted=(code,))], loaded, accepting)


@pytest.mark.parametrize("rate", [20, 200])
def test_negated_torques_of_an_arm_without_gravity_are_refused(robots, rate):
    """Negated torques of an arm without gravity are refused by their inertial part, at high and low sample rates.

    At 20 Hz accelerations cannot be filtered, and the estimated inertia is a tenth of its true value.
    """
    flat = load_arm(robots / "two_link.urdf")
    t = np.arange(0.0, 20.0, 1.0 / rate)
    q = np.stack([np.sin(1.3 * t), np.cos(2 * t) + 0.3 * np.sin(0.7 * t)], axis=1)
    qd = np.gradient(q, t, axis=0)
    torque = regressor(flat.chain, q, qd, np.gradient(qd, t, axis=0)) @ urdf_parameters(flat.chain)
    right = Trajectory(t, q, qd, torque + 0.3 * qd, "motion")
    assert check_logs([right], flat).errors == ()
    # if drives compensate more than their friction, torques fall with velocity: not mistaken for negated torques
    assert check_logs([replace(right, tau=torque - 0.3 * qd)], flat).errors == ()
    refused = check_logs([replace(right, tau=-right.tau)], flat)
    assert ("too slow for fits to torques" in refused.text()) == (rate < 24)
    assert "No findings" not in refused.text()
    assert check_logs([right[:1]], flat).errors == ()  # a log of one sample has no sample rate
    (error,) = refused.errors
    assert "all joints: got torques of the opposite sense" in str(error)
    assert "--accept torque-sense" in str(error)


def test_times_in_milliseconds_are_refused(loaded, log):
    with pytest.raises(SpelgenError) as caught:
        require_sound_logs([replace(log, t=1000 * log.t)], loaded)
    assert str(caught.value) == (
        "trajectory motion, joint 'joint1': got a sample every 9.99 s, 100.1 Hz if times are in ms, expected times in "
        "seconds; write 'units: {t: ms}' under 'logs' in the robot's YAML; --accept time-unit if it is right"
    )


def test_gravity_of_another_mounting_is_refused(robots, tmp_path, log):
    (tmp_path / "arm.urdf").write_bytes((robots / "rpr.urdf").read_bytes())
    (tmp_path / "arm.yaml").write_text("gravity: [0, 0, 9.81]\n")
    with pytest.raises(SpelgenError, match=r"'gravity: \[0, 0, -9.81\]' in the robot's YAML"):
        require_sound_logs([log], load_arm(tmp_path / "arm.urdf"))


def test_a_quantised_signal_is_reported(loaded, log):
    tau = log.tau.copy()
    step = np.ptp(tau[:, 0]) / 4
    tau[:, 0] = step * np.round(tau[:, 0] / step)
    assert "coarse" in {x.code for x in check_logs([replace(log, tau=tau)], loaded).findings}


def test_a_position_limit_that_is_reached_without_contact_is_not_reported(loaded, arm, log):
    """A position limit that a joint reaches without contact is not reported.

    A contact shows in the torques; `test_limits_in_logs` has joints at a stop.
    """
    coordinates = tuple(x._replace(upper=float(log.q[:, k].max())) for k, x in enumerate(arm.coordinates))
    limited = replace(loaded, chain=replace(arm, coordinates=coordinates))
    assert check_logs([log], limited).findings == ()


def test_a_joint_that_never_reverses_is_reported(loaded, log):
    forward = np.abs(log.qd[:, 0])
    q = np.column_stack([cumulative_trapezoid(forward, log.t, initial=0.0), log.q[:, 1:]])
    moved = replace(log, q=q, qd=np.column_stack([forward, log.qd[:, 1:]]), tau=np.ones_like(log.tau))
    one_way = [x.where for x in check_logs([moved], loaded).findings if x.code == "one-way"]
    assert one_way == [f"joint {loaded.chain.joint_names[0]!r}"]
    # a joint that reverses in another log is not reported
    back = replace(log, name="back")
    assert "one-way" not in {x.code for x in check_logs([moved, back], loaded).findings}


@pytest.mark.parametrize("samples_held", [1, 20])
def test_commands_on_round_levels_are_not_quantised(samples_held):
    random = np.random.default_rng(0)
    assert np.isnan(quantisation_step(np.repeat(random.integers(-2, 3, 100), samples_held).astype(float)))
    swing = 2.4 * np.sin(np.arange(2000) / 40)
    assert quantisation_step(np.round(swing)) == 1.0
    assert quantisation_step(np.round(swing + 0.4 * random.standard_normal(2000))) == 1.0
    # values of a slow logger are repeated, which does not change the quantisation step
    assert quantisation_step(np.repeat(np.round(swing[::5]), 5)) == 1.0


def test_no_coupling_is_found_by_chance(loaded, log):
    """For random-walk torques, which no parameters explain, no coupling of motors is found.

    The best of all couplings lowers the torque error a little by chance, but is not significant.
    """
    for seed in range(10):
        noise = np.random.default_rng(seed).standard_normal(log.tau.shape).cumsum(axis=0)
        alone = Drives(np.eye(3), np.eye(3))
        samples = drive_log(3, replace(log, tau=noise)).samples()
        assert find_coupling(drive_problem(body_chain(loaded.chain), alone, samples)) is None


def test_only_an_even_part_of_many_trajectories_is_filtered(monkeypatch):
    """If a log has many trajectories, only evenly spaced ones are filtered for each delay, to bound the time.

    A long log is read in many chunks: filtering all chunks for each delay would take minutes for 10^7 samples.
    """
    filtered = []

    def counted(moved, **options):
        filtered.append(moved[0].name)
        return dynamics_samples(moved, **options)

    monkeypatch.setattr(motion_samples, "dynamics_samples", counted)
    collected = drive_log(1)
    t = np.arange(0.0, 6.0, 0.02)
    for number in range(100):
        q = np.sin(t)[:, None] + 10.0 * number
        collected.add(Trajectory(t, q, np.cos(t)[:, None], q, str(number)))
    assert len(filtered) < 50
    steps = np.diff(np.unique(collected.samples().motion[0].round(-1)))
    assert steps.max() <= 1.5 * steps.min()


def drive_log(joints, *logs):
    alone = Drives(np.eye(joints), np.eye(joints))
    collected = DriveLog(["revolute"] * joints, alone, Preprocessing())
    for log in logs:
        collected.add(log)
    return collected


def test_a_coupling_of_recorded_logs_is_reported_before_a_fit(shared):
    tx40 = load_arm(shared / "logs" / "tx40" / "tx40.urdf")
    notes = require_sound_logs(read_logs([shared / "logs" / "tx40"], tx40), tx40)
    assert [x.where for x in notes if x.code == "coupled-motors"] == ["joint 'joint_6'"]


def test_seconds_of_recorded_logs_show_a_coupling(shared):
    """The coupling of the TX40's wrist is found in the first 5.4 s of its log.

    The coupling lowers the squared torque residual in each of ten blocks of the 5.4 s: by a factor of 1000 in one
    block, and of 3 to 20 in the others.
    """
    tx40 = load_arm(shared / "logs" / "tx40" / "tx40.urdf")
    (log,) = read_logs([shared / "logs" / "tx40"], tx40)
    notes = require_sound_logs([log[: int(np.searchsorted(log.t, log.t[0] + 5.4))]], tx40)
    assert [x.where for x in notes if x.code == "coupled-motors"] == ["joint 'joint_6'"]


@pytest.mark.parametrize("name", ["ga_N12T25", "opt"])
def test_degrees_of_a_recorded_arm_with_coarse_encoders_are_one_error(shared, name):
    """If angles of coarse encoders are logged in degrees, the only error is the unit: no signal is reported as frozen.

    In degrees, the steps of the encoders exceed thresholds in rad.
    """
    folder = shared / "logs" / "airbot"
    airbot = load_arm(folder / "airbot.urdf")
    (log,) = read_logs([folder / f"{name}.parquet"], airbot)
    (error,) = check_logs([replace(log, q=np.degrees(log.q), qd=np.degrees(log.qd))], airbot).errors
    assert "write 'units: {q: deg, qd: deg/s}' under 'logs'" in str(error)


def test_notes_of_several_joints_with_one_text_are_one_note(loaded, log):
    # with constant torques no fault of the geometry is searched, which would take five seconds
    speed = np.abs(log.qd)
    forward = replace(log, q=speed.cumsum(axis=0) * 0.01, qd=speed, tau=np.ones_like(log.tau))
    (finding,) = (x for x in check_logs([forward], loaded).findings if x.code == "one-way")
    assert finding.where == f"joint {', '.join(map(repr, loaded.chain.joint_names))}"


def test_a_constant_velocity_is_not_frozen(loaded, log):
    t = log.t[:, None]
    ramp = replace(log, q=0.05 * t + 0 * log.q, qd=0 * log.qd + 0.05)
    assert not any("always" in str(error) for error in check_logs([ramp], loaded).errors)


def test_a_recording_of_one_sample_is_not_split(log):
    with pytest.raises(LogError, match="got 1 sample, expected a motion"):
        split_validation([log[:1]], 0.2, 0)
