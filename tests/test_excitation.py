"""`spelgen excite`: motions stay within limits, start and end at rest, and are more informative than random ones."""

import csv
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

from spelgen.arm.configured_arm import load_arm
from spelgen.cli.main import app
from spelgen.errors import SettingsError, SpelgenErrors
from spelgen.excitation.bounds import motion_bounds
from spelgen.excitation.criterion import Criterion
from spelgen.excitation.design import excite
from spelgen.excitation.trajectory import ExcitationTrajectory
from tests.hand_built import coupled_urdf

CHOICE = {"duration": 10.0, "sample_rate": 100.0, "harmonics": 5, "reach": 0.8, "speed": 0.6}


@pytest.fixture(scope="module")
def loaded(robots):
    return load_arm(robots / "ur10e.urdf")


@pytest.fixture(scope="module")
def arm(loaded):
    return loaded.chain


@pytest.fixture(scope="module")
def found(loaded):
    return excite(loaded, **CHOICE, trials=40)


@pytest.mark.parametrize("seed", range(5))
def test_every_trajectory_keeps_limits_and_is_at_rest_at_both_ends(arm, seed):
    trajectory = ExcitationTrajectory(7.0, 6, motion_bounds(arm, 0.9, 0.5))
    parameters = 3 * np.random.default_rng(seed).standard_normal(trajectory.size)
    motion = trajectory.motion(parameters, np.linspace(0, 7, 5001))
    for k, coordinate in enumerate(arm.coordinates):
        assert 0.9 * coordinate.lower <= motion.q[:, k].min()
        assert motion.q[:, k].max() <= 0.9 * coordinate.upper
        assert np.abs(motion.qd[:, k]).max() <= 0.5 * coordinate.velocity
    for ends in (motion.qd[[0, -1]], motion.qdd[[0, -1]], motion.q[0] - motion.q[-1]):
        np.testing.assert_allclose(ends, 0, atol=1e-12)


def test_the_amplitude_is_the_largest_that_fits(arm):
    limits = motion_bounds(arm, 0.9, 0.5)
    trajectory = ExcitationTrajectory(7.0, 6, limits)
    parameters = np.random.default_rng(0).standard_normal((6, 14))
    parameters[:, -1] = 0
    motion = trajectory.motion(parameters.ravel(), np.linspace(0, 7, 5001))
    used = np.ptp(motion.q, axis=0) / (limits.high - limits.low)
    np.testing.assert_allclose(np.maximum(used, np.abs(motion.qd).max(axis=0) / limits.speed), 1, atol=4e-3)


def test_velocities_and_accelerations_are_derivatives(found):
    motion = found.motion
    middle = slice(1, -1)
    np.testing.assert_allclose(np.gradient(motion.q, motion.t, axis=0)[middle], motion.qd[middle], atol=2e-3)
    np.testing.assert_allclose(
        np.gradient(motion.qd, motion.t, axis=0)[middle], motion.qdd[middle], atol=2e-2
    )


def test_the_optimised_motion_is_more_informative(loaded, found):
    assert found.condition < found.first / 3
    assert (
        found.parameters == 36 + 6 * 4 - 2
    )  # 36 base parameters and 4 per joint (friction, rotor), less 2 that depend on the others
    assert (found.efforts < 1).all()
    assert excite(loaded, **CHOICE, trials=1).first == found.first


def test_a_random_motion_beyond_effort_limits_is_called_so(found):
    """If the torques of the first random motion exceed effort limits, `Excitation.text` says so.

    "beyond effort limits" follows the condition number of this motion, `first`. found: result of `excite`.
    """
    assert not found.first_overruns
    assert "beyond effort limits" not in found.text()
    assert f"{found.first:.3g}, beyond effort limits" in replace(found, first_overruns=True).text()


def test_the_optimised_motion_excites_all_base_parameters(arm, found):
    """The optimised motion excites all 36 base parameters: Pinocchio's rigid-body regressor along it has rank 36.

    Relative to the largest singular value, the 36th is above 1e-3 and the 37th below 1e-9.
    """
    pin = pytest.importorskip("pinocchio")
    from spelgen.dynamics.pinocchio_arm import pinocchio_model
    from spelgen.settings.settings import Settings

    model = pinocchio_model(arm, Settings())
    data = model.createData()
    motion = found.motion
    rows = [
        pin.computeJointTorqueRegressor(model, data, *state).copy()
        for state in zip(motion.q[::10], motion.qd[::10], motion.qdd[::10], strict=True)
    ]
    values = np.linalg.svd(np.concatenate(rows), compute_uv=False)
    # singular values, in decreasing order: the UR10e has 36 base parameters
    assert values[35] / values[0] > 1e-3 > 1e-9 > values[36] / values[0]


@pytest.mark.parametrize("robot", ["rpr", "scara"])
def test_the_gradient_is_that_of_the_criterion(robots, robot):
    """The gradient of the criterion equals central differences, with and without torques beyond the effort limits.

    The initial trajectory of rpr exceeds limits; scara has prismatic joints and joints without gravity load.
    """
    arm = load_arm(robots / f"{robot}.urdf").chain
    trajectory = ExcitationTrajectory(10.0, 3, motion_bounds(arm, 0.9, 0.7))
    criterion = Criterion(arm, trajectory)
    parameters = np.random.default_rng(4).standard_normal(trajectory.size)
    overran = np.nanmax(criterion.largest_efforts(criterion.states(parameters))) > 1
    assert overran == (robot == "rpr")
    value, gradient = criterion.value_and_gradient(parameters)
    assert value == pytest.approx(criterion.value(parameters), rel=1e-12)
    steps = 1e-5 * np.eye(trajectory.size)
    slopes = [(criterion.value(parameters + e) - criterion.value(parameters - e)) / 2e-5 for e in steps]
    np.testing.assert_allclose(gradient, slopes, rtol=1e-3, atol=1e-4 * np.abs(gradient).max())


def test_the_same_arguments_give_the_same_motion(loaded):
    found, again, other = (excite(loaded, **CHOICE, trials=6, seed=seed) for seed in (0, 0, 1))
    np.testing.assert_array_equal(again.motion.q, found.motion.q)
    assert not np.allclose(other.motion.q, found.motion.q)


def test_rounding_errors_of_the_processor_do_not_change_the_motion(loaded, monkeypatch):
    expected = excite(loaded, **CHOICE, trials=100).motion
    noise, exact = np.random.default_rng(0), Criterion.value_and_gradient

    def rounded_otherwise(criterion, parameters):
        value, gradient = exact(criterion, parameters)
        return value * (1 + 1e-14), gradient * (1 + 1e-14 * noise.standard_normal(len(gradient)))

    monkeypatch.setattr(Criterion, "value_and_gradient", rounded_otherwise)
    motion = excite(loaded, **CHOICE, trials=100).motion
    np.testing.assert_allclose(motion.q, expected.q, rtol=0, atol=1e-12)


def test_effort_limits_are_kept_where_they_can_be(robots):
    found = excite(load_arm(robots / "rpr.urdf"), **CHOICE | {"harmonics": 3}, trials=60)
    assert (found.efforts < 1).all()


def test_an_arm_without_limits_gets_modest_ones(tmp_path):
    text = """<robot name="r"><link name="a"/><link name="b"><inertial><mass value="1"/>
      <origin xyz="0.1 0 0"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
      <joint name="turn" type="continuous"><parent link="a"/><child link="b"/><axis xyz="0 1 0"/></joint></robot>"""
    (tmp_path / "one.urdf").write_text(text)
    one = excite(load_arm(tmp_path / "one.urdf"), **CHOICE, trials=50)
    assert 0.3 < np.abs(one.motion.qd).max() <= 0.6
    assert np.abs(one.motion.q).max() <= 0.8 * np.pi
    assert np.isnan(one.efforts).all()


def test_joints_that_follow_keep_their_limits_too(tmp_path):
    """A mimic joint stays within its own limits: b = 0.5 a - 0.1.

    The limits -0.3 <= b <= 0.2 and |db/dt| <= 0.1 rad/s of b give -0.4 <= a <= 0.6 and |da/dt| <= 0.2 rad/s, which are
    narrower than the limits of a.
    """
    path = coupled_urdf(tmp_path / "coupled.urdf")
    limits = 'lower="-1" upper="1" effort="10" velocity="2"/><mimic'
    path.write_text(
        path.read_text().replace(limits, 'lower="-0.3" upper="0.2" effort="10" velocity="0.1"/><mimic')
    )
    found = excite(load_arm(path), **CHOICE | {"reach": 1.0, "speed": 1.0}, trials=1)
    assert found.motion.q.shape == (1001, 1)
    assert -0.4 <= found.motion.q.min() < found.motion.q.max() <= 0.6
    assert 0.1 < np.abs(found.motion.qd).max() <= 0.2


@pytest.mark.parametrize(
    ("soft", "range_"),
    [((-0.5, 0.4), (-0.5, 0.4)), ((-9, 0.4), (-2, 0.4)), ((0, 0), (-2, 2)), ((3, 4), (-2, 2))],
)
def test_motions_keep_the_soft_limits_of_a_safety_controller(tmp_path, soft, range_):
    """Soft limits narrow the range of a motion; two zeros, and limits outside the range, are no soft limits."""
    path = tmp_path / "arm.urdf"
    path.write_text(
        '<robot name="r"><link name="a"/><link name="b"/><joint name="j" type="revolute"><parent link="a"/>'
        '<child link="b"/><limit lower="-2" upper="2" effort="1" velocity="1"/>'
        f'<safety_controller soft_lower_limit="{soft[0]}" soft_upper_limit="{soft[1]}"/></joint></robot>'
    )
    loaded = load_arm(path)
    bounds = motion_bounds(loaded.chain, 1.0, 1.0, loaded.robot.joint)
    assert (bounds.low[0], bounds.high[0]) == pytest.approx(range_)
    bounds = motion_bounds(loaded.chain, 1.0, 1.0, loaded.robot.joint, {"j": (-1.0, 1.0)})
    assert (bounds.low[0], bounds.high[0]) == pytest.approx((-1, 1))


def test_a_joint_without_room_is_refused(robots, tmp_path):
    text = (robots / "two_link.urdf").read_text()
    (tmp_path / "stuck.urdf").write_text(
        text.replace("-3.141592653589793", "1").replace("3.141592653589793", "1")
    )
    with pytest.raises(SpelgenErrors) as caught:
        excite(load_arm(tmp_path / "stuck.urdf"), **CHOICE, trials=1)
    assert str(caught.value).splitlines()[0] == (
        "joint 'joint1': got the limits 1 .. 1, expected a range to move in; correct them, omit the joint "
        "by --joints, or write 'simulation: {positions: {joint1: [LOWEST, HIGHEST]}}' into the robot's YAML"
    )


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"duration": -1}, "duration: got -1, expected a positive number"),
        ({"reach": 1.5}, "reach: got 1.5, expected more than 0, at most 1"),
        ({"harmonics": 1}, "harmonics: got 1, expected 2 or more"),
    ],
)
def test_values_out_of_range_are_refused(loaded, changes, message):
    with pytest.raises(SettingsError) as caught:
        excite(loaded, **CHOICE | changes)
    assert str(caught.value) == f"excite: {message}"


def test_a_notebook_shows_the_result(found):
    assert repr(found).startswith("<Excitation of 'ur10e': 10 s, condition number ")
    assert found._repr_html_().count("<tr>") == 7


def test_the_command(robots, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    command = ["excite", str(robots / "two_link.urdf"), "--duration", "5", "--trials", "60", "-o", "x.csv"]
    shown = CliRunner().invoke(app, command)
    assert shown.exit_code == 0, shown.stderr
    assert max(map(len, shown.stdout.splitlines())) <= 80
    assert "of the first motion at random" in shown.stdout
    # For two joints, 13 = 6 base parameters + 2 x 4 for friction and armature - 1, the armature of joint 1, which acts
    # like the inertia of link 1. The command prints these groups, since `inspect` states only the 6 base parameters.
    assert "of the regressor of 13 parameters: base parameters, friction and armature" in shown.stdout
    with open("x.csv", newline="") as file:
        head, *rows = csv.reader(file)
    assert head == ["t", "q_joint1", "q_joint2", "qd_joint1", "qd_joint2", "qdd_joint1", "qdd_joint2"]
    values = np.array(rows, dtype=float)
    assert (len(values), values[-1, 0]) == (501, 5.0)
    assert not values[[0, -1], 3:].any()
    first = (tmp_path / "x.csv").read_bytes()
    refused = CliRunner().invoke(app, command)
    assert (refused.exit_code, "--force" in refused.stderr) == (1, True)
    assert CliRunner().invoke(app, [*command, "--force"]).exit_code == 0
    assert (tmp_path / "x.csv").read_bytes() == first
