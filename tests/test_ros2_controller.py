"""The exported ros2_control controller, compiled against substitutes of the ROS 2 headers, controls a simulated arm."""

import re
import shutil

import numpy as np
import pytest
import torch
import yaml
from exported_runs import COUPLED, MOTORS, arm_of, moved_model
from ros2_controller import PERIOD, Controller, SimulatedArm, compiled

from spelgen import build, load_arm
from spelgen.exporting.export import export
from spelgen.exporting.ros2_export import cpp_string

pytestmark = pytest.mark.skipif(
    not all(shutil.which(program) for program in ("gcc", "g++")), reason="no gcc or no g++ on this machine"
)

START = np.array([0.3, -0.7])
RATES = {"gravity_damping": 0.5, "damping": 5.0}
EFFORT = np.array([c.effort for c in arm_of("two_link").chain.coordinates])


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    """Return a model, the library of its controller, the simulated arm, and the folder of the exported package."""
    model, folder = moved_model("two_link", "closed-form"), tmp_path_factory.mktemp("controller")
    export(model, "ros2", folder / "package", arm=arm_of("two_link"))
    library = compiled(folder / "package", folder)
    return model, library, SimulatedArm(model, arm_of("two_link"), folder), folder / "package"


def started(arm, **parameters):
    """Return a controller that takes its own commands as measured efforts, and the simulated arm, at START.

    parameters: of the controller.
    """
    _, library, simulated, _ = arm
    simulated.start(START)
    return Controller(library, 2, **{"measured_effort": False} | parameters), simulated


def torques(model, q, qd, qdd, friction_of=None):
    """Return the torques (n,) [Nm, N] of the inverse dynamics of the torch model at q, qd and qdd, (n,) each.

    friction_of: velocities (n,) at which the joints slid before, which determine the friction states; None: the joints
    have not moved.
    """
    states = [torch.as_tensor(x, dtype=torch.float64) for x in (q, qd, qdd)]
    moved_at = states[1] * 0 if friction_of is None else torch.as_tensor(friction_of)
    return model.inverse_dynamics(*states, model.memory(moved_at)).numpy()


def circle(t, start=START):
    """Return a sinusoidal reference motion of the two joints at time t [s]: q [rad], qd and qdd, (2,) each.

    start: positions of the joints at t = 0, (2,) [rad], at which the motion starts from rest.
    """
    sign, w = np.array([1.0, -1.0]), 2.0
    return (
        start + 0.4 * sign * (1 - np.cos(w * t)),
        0.4 * sign * w * np.sin(w * t),
        0.4 * sign * w**2 * np.cos(w * t),
    )


def publishing(controller, every=10):
    """Return a function of time that publishes the reference `circle` in every tenth control cycle."""

    def at_each(t):
        if round(t / PERIOD) % every == 0:
            controller.reference(*circle(t))

    return at_each


def test_it_claims_effort_commands_and_exports_references(arm):
    _, library, _, _ = arm
    names = Controller(library, 2).text("interfaces").split()
    assert names[:2] == ["joint1/effort", "joint2/effort"]
    assert names[2:8] == [
        f"{joint}/{x}" for x in ("position", "velocity", "effort") for joint in ("joint1", "joint2")
    ]
    assert names[8:] == [
        f"arm/{joint}/{x}" for x in ("position", "velocity", "acceleration") for joint in ("joint1", "joint2")
    ]
    left = Controller(library, 2, measured_effort=False, joint_prefix="left_").text("interfaces").split()
    assert left[0] == "left_joint1/effort"
    assert len(left) == 2 + 4 + 6


def test_gravity_compensation_holds_the_arm_still(arm):
    controller, simulated = started(arm)
    q, _, tau = simulated.run(controller, 1.0)
    np.testing.assert_allclose(q, np.tile(START, (len(q), 1)), rtol=0, atol=1e-12)
    expected = torques(arm[0], START, [0, 0], [0, 0])
    assert np.linalg.norm(expected) > 5
    np.testing.assert_allclose(tau[-1], expected, rtol=1e-12)
    assert controller.text("state") == "gravity_compensation"
    assert controller.allocations == 0


def test_gravity_compensation_damps_a_moving_arm(arm):
    controller, _ = started(arm, **RATES)
    tau = controller.update(START, [0.5, -0.4])
    np.testing.assert_allclose(tau, torques(arm[0], START, [0, 0], [-0.25, 0.2]), rtol=1e-12)


def test_computed_torque_is_the_law_of_the_torch_model(arm):
    controller, _ = started(arm, mode="computed_torque", kp=[50.0, 80.0], kd=[10.0, 15.0])
    q, qd = START + np.array([0.03, -0.02]), np.array([0.1, -0.2])
    q_ref, qd_ref, qdd_ref = START, np.array([0.2, -0.1]), np.array([-1.0, 1.0])
    controller.reference(q_ref, qd_ref, qdd_ref)
    wanted = qdd_ref + np.array([50.0, 80.0]) * (q_ref - q) + np.array([10.0, 15.0]) * (qd_ref - qd)
    expected = torques(arm[0], q, qd_ref, wanted, friction_of=qd_ref)
    assert (np.abs(expected) < EFFORT).all()
    np.testing.assert_allclose(controller.update(q, qd), expected, rtol=1e-12)


def test_computed_torque_tracks_references_by_topic(arm):
    controller, simulated = started(arm, mode="computed_torque")
    q, _, _ = simulated.run(controller, 3.0, publishing(controller))
    error = np.abs(q - [circle(k * PERIOD)[0] for k in range(len(q))])
    assert error.max() < 5e-4
    assert controller.text("state") == "computed_torque"
    assert controller.allocations == 0


def test_without_the_model_the_same_gains_do_not_track(arm):
    """If a tenth of the gravity torque is missing in the model, the tracking error exceeds 2 mrad, with equal gains."""
    controller, simulated = started(arm, mode="computed_torque")
    unknown = torques(arm[0], START, [0, 0], [0, 0]) / 10
    worst = 0.0
    for cycle in range(1000):
        t = cycle * PERIOD
        controller.reference(*circle(t))
        simulated.step(controller.update(simulated.q, simulated.qd) - unknown)
        worst = max(worst, np.abs(simulated.q - circle(t)[0]).max())
    assert worst > 2e-3


def test_a_preceding_controller_is_tracked(arm):
    controller, simulated = started(arm, mode="computed_torque")
    controller.call("chain", 1)
    q, _, _ = simulated.run(controller, 1.0, lambda t: controller.write(*circle(t)))
    assert np.abs(q - [circle(k * PERIOD)[0] for k in range(len(q))]).max() < 5e-4
    # Values that the preceding controller writes are used for one cycle only: without new values, joints are damped.
    _, qd, _ = simulated.run(controller, 1.5)
    assert controller.text("state") == "damping: no reference within reference_timeout"
    assert np.abs(qd[0]).max() > 0.3
    assert np.abs(qd[-1]).max() < 1e-3
    # The preceding controller may write only positions: velocities and accelerations are NaN here. The reference on the
    # topic is 1 rad away from the arm. It is ignored in chained mode; after chained mode ends, it is used, and causes
    # damping because of its distance.
    controller.reference(simulated.q + 1.0)
    controller.write(simulated.q, [np.nan] * 4)
    controller.update(simulated.q, simulated.qd)
    assert controller.text("state") == "computed_torque"
    controller.call("chain", 0)
    controller.update(simulated.q, simulated.qd)
    assert controller.text("state") == "damping: the reference is farther away than max_position_error"


def test_a_reference_that_stops_ends_in_damping_and_a_new_one_resumes(arm):
    controller, simulated = started(arm, mode="computed_torque", **RATES)
    simulated.run(controller, 0.5, publishing(controller))
    moving = np.abs(simulated.qd).max()
    simulated.run(controller, 0.09)
    assert controller.text("state") == "computed_torque"  # within the timeout the reference is extrapolated
    simulated.run(controller, 0.02)
    assert controller.text("state") == "damping: no reference within reference_timeout"
    tau = controller.update(simulated.q, simulated.qd)
    expected = torques(arm[0], simulated.q, [0, 0], -5 * simulated.qd)
    np.testing.assert_allclose(tau, expected, rtol=1e-12)
    q, qd, _ = simulated.run(controller, 1.5)
    assert moving > 0.3
    assert np.abs(qd[-1]).max() < 1e-3
    assert np.abs(q[-1] - q[-500]).max() < 1e-3
    controller.reference(simulated.q)
    controller.update(simulated.q, simulated.qd)
    assert controller.text("state") == "computed_torque"


@pytest.mark.parametrize(
    ("reference", "reason"),
    [
        (
            (START + np.array([np.nan, 0]), [0, 0]),
            "the reference is not finite or has the wrong number of joints",
        ),
        ((START, [0, np.inf]), "the reference is not finite or has the wrong number of joints"),
        ((START[:1],), "the reference is not finite or has the wrong number of joints"),
        ((START, [0.0]), "the reference is not finite or has the wrong number of joints"),
        ((START + np.array([0.0, 0.21]),), "the reference is farther away than max_position_error"),
        ((START + np.array([1e300, 0.0]),), "the reference is farther away than max_position_error"),
    ],
)
def test_a_bad_reference_ends_in_damping(arm, reference, reason):
    controller, _ = started(arm, mode="computed_torque", **RATES)
    controller.reference(START, [0.1, 0.1])
    controller.update(START, [0.1, 0.1])
    assert controller.text("state") == "computed_torque"
    controller.reference(*reference)
    tau = controller.update(START, [0.1, 0.1])
    np.testing.assert_allclose(tau, torques(arm[0], START, [0, 0], [-0.5, -0.5]), rtol=1e-12)
    assert controller.text("state") == f"damping: {reason}"
    assert controller.text("log") == f"damping: {reason}"
    controller.reference(START, [0.1, 0.1])
    controller.update(START, [0.1, 0.1])
    assert controller.text("state") == "computed_torque"


INVALID = "damping: a position or velocity is not finite, or positions jumped"


@pytest.mark.parametrize("mode", ["gravity_compensation", "computed_torque"])
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_states_that_are_not_finite_end_in_damping(arm, mode, bad):
    controller, _ = started(arm, mode=mode, **RATES)
    qd = np.array([0.2, -0.1])
    controller.reference(START)
    controller.update(START, qd)
    before = controller.text("state")
    tau = controller.update([bad, START[1]], qd)
    # The torques are the gravity at the last valid position plus M times the acceleration -5 qd, which damps the
    # velocities. Velocities that are not finite count as zero.
    np.testing.assert_allclose(tau, torques(arm[0], START, [0, 0], -5 * qd), rtol=1e-12)
    tau = controller.update(START, [bad, -0.1])
    np.testing.assert_allclose(tau, torques(arm[0], START, [0, 0], [0, 0.5]), rtol=1e-12)
    assert controller.text("state") == INVALID
    controller.update(START, qd)
    assert controller.text("state") == before


def test_a_state_that_stays_invalid_is_latched_until_the_next_activation(arm):
    controller, _ = started(arm)
    controller.update(START, [0, 0])
    for _ in range(int(0.1 / PERIOD) + 2):
        tau = controller.update([np.nan, np.nan], [np.nan, np.nan])
        np.testing.assert_allclose(tau, torques(arm[0], START, [0, 0], [0, 0]), rtol=1e-12)
    # after the next valid state, gravity and the damping acceleration -5 qd are computed from this state
    tau = controller.update(START + np.array([0.01, 0.02]), [0.1, -0.2])
    expected = torques(arm[0], START + np.array([0.01, 0.02]), [0, 0], [-0.5, 1.0])
    np.testing.assert_allclose(tau, expected, rtol=1e-12)
    assert controller.text("state") == INVALID
    np.testing.assert_array_equal(controller.deactivate(), [0, 0])
    controller.activate()
    controller.update(START, [0, 0])
    assert controller.text("state") == "gravity_compensation"


def test_without_any_valid_state_torques_are_zero(arm):
    controller, _ = started(arm)
    np.testing.assert_array_equal(controller.update([np.nan, 0], [0, 0]), [0, 0])
    assert controller.text("state") == INVALID


def test_interfaces_in_use_by_another_thread_are_an_invalid_state(arm):
    controller, _ = started(arm)
    controller.update(START, [0, 0])
    tau = controller.update(START, [0, 0], available=False)
    np.testing.assert_allclose(tau, torques(arm[0], START, [0, 0], [0, 0]), rtol=1e-12)
    assert controller.text("state") == INVALID


def test_a_frozen_state_ends_in_damping(arm):
    """If the hardware repeats the last state of a moving arm, damping does not use the velocity of that state."""
    controller, _ = started(arm, mode="computed_torque")
    qd = np.array([0.3, 0.0])
    for cycle in range(300):
        controller.reference(START, qd)
        tau = controller.update(START, qd)
        assert cycle in (100, 101) or (controller.text("state") == "computed_torque") == (cycle < 100)
    assert controller.text("state") == "damping: positions do not change although velocities are not zero"
    np.testing.assert_allclose(tau, torques(arm[0], START, [0, 0], [0, 0]), rtol=1e-12)


def test_an_arm_at_rest_and_a_slow_encoder_are_not_frozen(arm):
    controller, _ = started(arm)
    random = np.random.default_rng(0)
    for cycle in range(2000):
        noise = 0.02 * random.standard_normal(2) + [0.03, 0.0]  # the velocity has noise and an offset
        q = START + np.floor(cycle / 50) * 1e-3  # the joints move at 0.02 rad/s, in encoder steps of 1 mrad
        controller.update(q if cycle < 1000 else START + 0.02, noise + (0.02 if cycle < 1000 else 0))
        assert controller.text("state") == "gravity_compensation"


def test_a_jump_of_positions_is_an_invalid_state(arm):
    controller, _ = started(arm)
    controller.update(START, [0, 0])
    tau = controller.update(START + np.array([0, 0.5]), [0, 0])
    np.testing.assert_allclose(tau, torques(arm[0], START, [0, 0], [0, 0]), rtol=1e-12)
    assert controller.text("state") == INVALID


def test_joints_above_their_velocity_limit_are_damped(arm):
    controller, _ = started(arm, velocity_limits=[0.5, 1.0], **RATES)
    tau = controller.update(START, [0.6, 0.1])
    np.testing.assert_allclose(tau, torques(arm[0], START, [0, 0], [-3.0, -0.5]), rtol=1e-12)
    assert controller.text("state") == "damping: a velocity is above its limit"


def test_torques_are_limited(arm):
    controller, _ = started(arm, mode="computed_torque", torque_limits=[5.0, 2.0])
    controller.reference(START + np.array([0.19, -0.19]))
    unlimited = torques(arm[0], START, [0, 0], [19, -19])
    assert (np.abs(unlimited) > [5, 2]).all()
    np.testing.assert_allclose(controller.update(START, [0, 0]), [5, 2] * np.sign(unlimited), rtol=0)


def test_hostile_inputs_never_give_torques_beyond_the_limits(arm):
    controller, _ = started(arm, mode="computed_torque")
    random = np.random.default_rng(1)
    values = np.array([0.0, -0.0, 1e-320, 1e300, -1e300, np.inf, -np.inf, np.nan, 3.0, 1e6])
    for cycle in range(20_000):
        q, qd, reference = START + 0.01 * random.standard_normal((3, 2))
        for target in (q, qd, reference):
            if random.random() < 0.1:
                target[random.integers(2)] = random.choice(values)
        if cycle % 3 == 0:
            controller.reference(reference, qd, q)
        if cycle % 1000 == 0:
            controller.activate()
        period = random.choice([PERIOD, PERIOD, PERIOD, 0.0, -1.0, 10.0, np.nan])
        tau = controller.update(q, qd, period=PERIOD if np.isnan(period) else period)
        assert np.isfinite(tau).all()
        assert (np.abs(tau) <= EFFORT).all()
    assert controller.allocations == 0


def test_parameters_are_validated_and_take_effect(arm):
    controller, _ = started(arm)
    limits = dict(line.split(" ", 1) for line in controller.text("ranges").splitlines())
    assert limits["damping"].startswith("0.100000 100.000000 decay rate")
    assert {"kp", "kd", "torque_limits", "reference_timeout", "publish_rate"} < set(limits)
    effort = f"{EFFORT[1]:g}"
    for name, value, reason in [
        ("kp", [1.0], "kp: got 1 values, expected 2, one per joint"),
        ("kd", [1.0, -1.0], "kd: got -1 for joint joint2, expected 0 to 1000"),
        ("kd", [np.nan, 1.0], "kd: got nan for joint joint1, expected 0 to 1000"),
        ("damping", np.nan, "damping: got nan, expected 0.1 to 100"),
        (
            "torque_limits",
            [1.0, 1e4],
            f"torque_limits: got 10000 for joint joint2, expected 1e-06 to {effort}",
        ),
        ("mode", "gravity", "mode: got 'gravity', expected one of gravity_compensation, computed_torque"),
    ]:
        assert controller.set(name, value) == reason
        with pytest.raises(ValueError, match=re.escape(reason)):
            Controller(arm[1], 2, **{name: value})
    assert "range" in controller.set("damping", 1000.0)
    assert controller.set("gravity_damping", 2.0) is None
    tau = controller.update(START, [0.5, -0.4])
    np.testing.assert_allclose(tau, torques(arm[0], START, [0, 0], [-1.0, 0.8]), rtol=1e-12)
    assert controller.set("mode", "computed_torque") is None
    controller.update(START, [0.0, 0.0])
    assert controller.text("state") == "damping: no reference within reference_timeout"


def test_the_parameter_file_has_the_parameters_and_their_defaults(arm):
    _, library, _, package = arm
    parameters = yaml.safe_load((package / "config" / "controller.yaml").read_text())
    own = parameters["two_link_controller"]["ros__parameters"]
    manager = parameters["controller_manager"]["ros__parameters"]["two_link_controller"]
    assert own.pop("type") == manager["type"] == "two_link_dynamics/Controller"
    trajectories = parameters["joint_trajectory_controller"]["ros__parameters"]
    assert trajectories["joints"] == ["joint1", "joint2"]
    assert trajectories["command_joints"] == ["two_link_controller/joint1", "two_link_controller/joint2"]
    controller = Controller(library, 2, **own)
    assert set(own) == set(controller.text("parameters").split())
    assert all(controller.set(name, value) is None for name, value in own.items() if isinstance(value, list))


def test_it_is_built_for_humble(arm, tmp_path):
    _, _, simulated, package = arm
    library = compiled(package, tmp_path, "-DRCLCPP_VERSION_MAJOR=16")
    simulated.start(START)
    controller = Controller(library, 2, measured_effort=False, mode="computed_torque")
    controller.call("chain", 1)
    q, _, _ = simulated.run(controller, 0.5, lambda t: controller.write(*circle(t)))
    assert np.abs(q - [circle(k * PERIOD)[0] for k in range(len(q))]).max() < 5e-4
    with pytest.raises(ValueError, match="kd: got 5000 for joint joint1, expected 0 to 1000"):
        Controller(library, 2, kd=[5000.0, 1.0])


def test_joints_without_effort_limits_need_a_parameter(tmp_path):
    urdf = tmp_path / "arm.urdf"
    urdf.write_text(COUPLED)
    arm = load_arm(urdf)
    exported = export(build(arm, "closed-form"), "ros2", tmp_path / "package", arm=arm)
    assert "no estimator: its noise levels are found from the training logs of a fit" in repr(exported)
    library = compiled(tmp_path / "package", tmp_path)
    with pytest.raises(ValueError, match="torque_limits: got 0 for joint wrist, expected 1e-06 to 100000"):
        Controller(library, 3, measured_effort=False)
    controller = Controller(library, 3, measured_effort=False, torque_limits=[50.0, 50.0, 9.0])
    turns = 4 * np.pi  # the wrist is continuous: whole turns between reference and position are no error
    controller.set("mode", "computed_torque")
    controller.reference([0.1, 0.2, 0.3 + turns])
    controller.update([0.1, 0.2, 0.3], [0, 0, 0])
    assert controller.text("state") == "computed_torque"


def test_arms_with_passive_joints_get_the_solver_only(tmp_path):
    urdf = tmp_path / "arm.urdf"
    urdf.write_text(COUPLED)
    urdf.with_suffix(".yaml").write_text(MOTORS)
    arm = load_arm(urdf)
    exported = export(build(arm, "closed-form"), "ros2", tmp_path / "package", arm=arm)
    assert "no estimator" not in repr(exported)
    assert "no controller: it needs an effort interface of every joint" in repr(exported)
    assert not (tmp_path / "package/src/controller.cpp").exists()
    assert "controller" not in (tmp_path / "package/package.xml").read_text().replace(
        "ros2_control controller", ""
    )


def test_names_from_a_file_are_not_code():
    assert cpp_string("joint_1") == '"joint_1"'
    assert cpp_string('a"; } int b??/') == r'"a\042\073\040\175\040int\040b\077\077/"'
    assert cpp_string("ä1") == r'"\303\2441"'
