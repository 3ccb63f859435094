"""Rigid-body dynamics equal Pinocchio's dynamics of the URDF, and equations that are derived by hand."""

from fractions import Fraction

import numpy as np
import pinocchio as pin
import pytest
import torch

from spelgen.arm.arm import make_arm
from spelgen.arm.configured_arm import load_arm
from spelgen.dynamics.pinocchio_arm import arm_dynamics, pinocchio_model
from spelgen.dynamics.pinocchio_dynamics import urdf_dynamics
from spelgen.dynamics.protocol import integrable
from spelgen.dynamics.regressor_dynamics import RegressorDynamics, urdf_parameters
from spelgen.dynamics.tip import tip_kinematics
from spelgen.errors import ArmError, SpelgenErrors
from spelgen.settings.settings import JointSettings, Settings, load_settings
from spelgen.urdf.read import read_urdf
from tests.hand_built import SIDEWAYS, arm, body, coordinate, point, slider

SIX = ("two_link", "rpr", "six_dof", "scara", "panda", "ur10e")


@pytest.mark.parametrize("robot", SIX)
def test_an_arm_equals_pinocchios_reading_of_the_file(robot, robots):
    path = robots / f"{robot}.urdf"
    gravity = load_settings(path).gravity
    engine = arm_dynamics(make_arm(read_urdf(path), gravity=gravity), Settings())
    model = pin.buildModelFromUrdf(str(path))
    model.gravity.linear = np.array(gravity)
    data = model.createData()
    assert list(engine.model.names) == list(model.names)
    for q, qd, tau in np.random.default_rng(0).normal(size=(20, 3, model.nq)):
        expected = np.triu(pin.crba(model, data, q))
        np.testing.assert_allclose(np.triu(engine.mass_matrix(q)), expected, atol=1e-10)
        np.testing.assert_allclose(
            engine.nonlinear_effects(q, 0 * qd), pin.computeGeneralizedGravity(model, data, q), atol=1e-10
        )
        np.testing.assert_allclose(engine.nonlinear_effects(q, qd), pin.nle(model, data, q, qd), atol=1e-10)
        acceleration = pin.aba(model, data, q, qd, tau)
        np.testing.assert_allclose(engine.forward_dynamics(q, qd, tau), acceleration, rtol=1e-10, atol=1e-10)


def test_rotors_count_by_the_square_of_their_gear(robots):
    path = robots / "two_link.urdf"
    geared = Settings(joints={"joint2": JointSettings(rotor_inertia=0.01, gear=10.0)})
    plain, with_rotor = (
        arm_dynamics(make_arm(read_urdf(path)), settings) for settings in (Settings(), geared)
    )
    q, qd, tau = np.random.default_rng(0).normal(size=(3, 2))
    added = with_rotor.mass_matrix(q) - plain.mass_matrix(q)
    np.testing.assert_allclose(added, [[0, 0], [0, 1]], atol=1e-14)
    qdd = with_rotor.forward_dynamics(q, qd, tau)
    np.testing.assert_allclose(
        with_rotor.mass_matrix(q) @ qdd + with_rotor.nonlinear_effects(q, qd), tau, atol=1e-12
    )


def test_a_telescope_moves_its_second_stage_twice():
    """Stage 2 of a telescope slides on stage 1 and mimics it with the factor 2, so its velocity is (1 + 2) qd.

    M is therefore m1 + 3^2 m2, plus the rotor inertia times the gear ratio squared: 2 + 9 * 5 + 0.5 * 2^2.
    """
    first = body(kind="prismatic", rotation=SIDEWAYS, inertia=point(2))
    second = body("b", "prismatic", parent=0, multiplier=Fraction(2), inertia=point(5))
    telescope = arm([coordinate(kind="prismatic")], [first, second], gravity=(-10, 0, 0))
    settings = Settings(joints={"a": JointSettings(rotor_inertia=0.5, gear=2.0)})
    engine = arm_dynamics(telescope, settings)
    q = np.array([0.3])
    np.testing.assert_allclose(engine.mass_matrix(q), [[2 + 9 * 5 + 0.5 * 4]])
    np.testing.assert_allclose(engine.nonlinear_effects(q, q), [10 * (2 + 3 * 5)])
    np.testing.assert_allclose(engine.forward_dynamics(q, q, np.array([3.0])), [(3 - 170) / 49])


def test_a_mimic_elbow_is_a_pendulum_with_a_varying_inertia():
    """With a mimic elbow a pendulum has a varying inertia; its dynamics equal equations that are derived by hand.

    Two point masses at length L; the elbow is -q/2 + 0.3, so that the angle of the second rod is b = q/2 + 0.3:

    M = L^2 (m1 + m2 (5/4 + cos(q - b))),  V = g L (m1 sin q + m2 (sin q + sin b)),  M qdd + M' qd^2/2 + V' = tau.
    """
    m1, m2, length, g = 1.5, 0.8, 0.6, 9.81
    shoulder = body(inertia=point(m1, length))
    elbow = body(
        "b",
        parent=0,
        multiplier=Fraction(-1, 2),
        offset=0.3,
        translation=(length, 0, 0),
        inertia=point(m2, length),
    )
    engine = arm_dynamics(arm([coordinate()], [shoulder, elbow], gravity=(0, -g, 0)), Settings())
    for q, qd, tau in np.random.default_rng(0).normal(size=(5, 3)):
        b = q / 2 + 0.3
        mass = length**2 * (m1 + m2 * (1.25 + np.cos(q - b)))
        slope = -(length**2) * m2 * np.sin(q - b) / 2
        weight = g * length * (m1 * np.cos(q) + m2 * (np.cos(q) + np.cos(b) / 2))
        qdd = (tau - slope * qd**2 / 2 - weight) / mass
        state = np.array([q]), np.array([qd])
        np.testing.assert_allclose(engine.mass_matrix(state[0]), [[mass]], rtol=1e-13)
        np.testing.assert_allclose(engine.nonlinear_effects(*state), [slope * qd**2 / 2 + weight], rtol=1e-12)
        np.testing.assert_allclose(engine.forward_dynamics(*state, np.array([tau])), [qdd], rtol=1e-12)


def test_a_massless_body_with_a_tensor_keeps_it():
    flywheel = body("b", parent=0, coordinate=1, inertia=(0, 0, 0, 0, 0, 0, 0, 0, 0, 3.0))
    engine = arm_dynamics(arm([coordinate(), coordinate("b")], [body(), flywheel]), Settings())
    np.testing.assert_array_equal(engine.mass_matrix(np.zeros(2)), [[3, 3], [3, 3]])


def test_accelerations_are_no_view_into_the_engine():
    engine = arm_dynamics(slider(mass=2.0), Settings())
    at_rest = np.zeros(1)
    first = engine.forward_dynamics(at_rest, at_rest, np.array([2.0]))
    engine.forward_dynamics(at_rest, at_rest, np.array([8.0]))
    assert first == [1.0]


def test_bodies_without_inertials_are_all_named():
    bare = arm([coordinate(), coordinate("b")], [body(inertia=None), body("b", coordinate=1, inertia=None)])
    with pytest.raises(SpelgenErrors) as error:
        pinocchio_model(bare, Settings())
    told = str(error.value).splitlines()
    assert [x.split(": ")[0] for x in told] == ["joint 'a'", "joint 'b'"]
    assert all(
        "got a link without <inertial>, expected mass" in x and "write estimates into the URDF" in x
        for x in told
    )
    assert all(isinstance(each, ArmError) for each in error.value.errors)


def test_a_negative_mass_is_refused():
    """A body with a negative mass is an error, since Pinocchio returns meaningless numbers without an error."""
    negative = arm([coordinate()], [body(inertia=(-1, 0, 0, 0, 1, 0, 0, 1, 0, 1))])
    with pytest.raises(ArmError, match=r"joint 'a': got a body of -1 kg, expected mass.*write estimates"):
        pinocchio_model(negative, Settings())


# A lift with mimic joints. Stage 2 slides on stage 1, twice as far as stage 1 on the base. A pendulum of two rods is on
# stage 2: rod 2 rotates on rod 1, in the opposite direction to rod 1. Finger 2 mimics the joint `grip`, which is no
# coordinate of the arm, so `grip` is locked at 0 and finger 2 at its offset.
LIFT = """<robot name="lift"><link name="base"/>
  <joint name="low" type="prismatic"><parent link="base"/><child link="stage1"/><axis xyz="0 0 1"/>
    <limit lower="0" upper="1" effort="10" velocity="1"/><dynamics damping="2" friction="0.5"/></joint>
  <joint name="high" type="prismatic"><parent link="stage1"/><child link="stage2"/><axis xyz="0 0 1"/>
    <limit lower="0" upper="2" effort="10" velocity="1"/><mimic joint="low" multiplier="2" offset="0.1"/></joint>
  <joint name="swing" type="continuous"><parent link="stage2"/><child link="rod1"/><axis xyz="0 1 0"/></joint>
  <joint name="back" type="continuous"><parent link="rod1"/><child link="rod2"/><origin xyz="0.3 0 0.4"/>
    <axis xyz="0 1 0"/><mimic joint="swing" multiplier="-1.5" offset="0.2"/></joint>
  <joint name="grip" type="revolute"><parent link="rod2"/><child link="finger1"/><origin xyz="0.1 0 0"/>
    <axis xyz="0 0 1"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
  <joint name="gripped" type="revolute"><parent link="finger1"/><child link="finger2"/><origin xyz="0.2 0 0"/>
    <axis xyz="0 0 1"/><limit lower="-1" upper="1" effort="1" velocity="1"/><mimic joint="grip" offset="0.7"/></joint>
"""
LIFT += "".join(
    f"""<link name="{name}"><inertial><origin xyz="0.1 0.05 {0.1 * k}"/><mass value="{k}"/>
    <inertia ixx="0.3" ixy="0.02" ixz="0" iyy="0.2" iyz="0.01" izz="0.25"/></inertial></link>"""
    for k, name in enumerate(("stage1", "stage2", "rod1", "rod2", "finger1", "finger2"), start=1)
)
# a colour by its name in Gazebo, which other parsers refuse
LIFT = LIFT.replace(
    '<link name="stage1">', '<link name="stage1"><visual><material>Gazebo/Red</material></visual>', 1
)
LIFT += "</robot>"


def states(n, count=5):
    random = torch.Generator().manual_seed(0)
    return torch.randn(3, 2, count, n, generator=random, dtype=torch.float64)


def same_dynamics(one, other, joints, tolerance):
    q, qd, tau = states(joints)
    for name, arguments in (
        ("mass_matrix", (q,)),
        ("gravity", (q,)),
        ("nonlinear_effects", (q, qd)),
        ("friction_torque", (q, qd)),
        ("forward_dynamics", (q, qd, tau)),
        ("inverse_dynamics", (q, qd, tau)),
    ):
        found, expected = (getattr(each, name)(*arguments) for each in (one, other))
        assert found.shape == (2, 5, *(joints,) * (1 + (name == "mass_matrix")))
        torch.testing.assert_close(found, expected, atol=tolerance, rtol=tolerance)
    assert one.n == other.n == joints


def test_mimic_and_locked_joints_are_the_arms(tmp_path):
    """Dynamics of an arm with mimic and locked joints equal Pinocchio's dynamics with the same constraints."""
    path = tmp_path / "lift.urdf"
    path.write_text(LIFT)
    lift = make_arm(read_urdf(path), joints=["low", "swing"])
    own = arm_dynamics(lift, Settings(), lambda qd: np.array([2.0, 0]) * qd + [0.5, 0] * np.tanh(qd / 0.05))
    same_dynamics(urdf_dynamics(path, ("low", "swing")), own, 2, 1e-9)


@pytest.mark.parametrize("robot", ["rpr", "panda"])
def test_the_regressors_dynamics_are_pinocchios(robot, robots):
    path = robots / f"{robot}.urdf"
    whole = make_arm(read_urdf(path))
    n = len(whole.coordinates)
    rotors = Settings(joints={c.name: JointSettings(rotor_inertia=0.3) for c in whole.coordinates})
    found = RegressorDynamics(whole, urdf_parameters(whole), np.full(n, 0.3), lambda qd, _: 1.5 * qd)
    same_dynamics(found, arm_dynamics(whole, rotors, lambda qd: 1.5 * qd), n, 1e-9)


def test_dynamics_without_momenta_are_integrated_in_velocities(robots):
    rpr = arm_dynamics(make_arm(read_urdf(robots / "rpr.urdf")), Settings())
    q, qd, tau = (x[0] for x in states(3))
    form = integrable(rpr)
    assert integrable(form) is form
    torch.testing.assert_close(form.velocity(q, form.momentum(q, qd)), qd)
    for found, expected in zip(
        form.port_hamiltonian_rhs(q, qd, tau, form.prepare()),
        (qd, rpr.forward_dynamics(q, qd, tau)),
        strict=True,
    ):
        torch.testing.assert_close(found, expected)


@pytest.mark.parametrize("robot, link", [("panda", None), ("ur10e", None), ("lift", "finger2")])
def test_pose_and_jacobian_of_the_tip_are_pinocchios(robot, link, robots, tmp_path):
    path = tmp_path / "lift.urdf" if robot == "lift" else robots / f"{robot}.urdf"
    if robot == "lift":
        path.write_text(LIFT)
    loaded = load_arm(path, ["low", "swing"] if robot == "lift" else None)
    joints = [c.name for c in loaded.chain.coordinates]
    tip, dynamics = tip_kinematics(loaded, link), urdf_dynamics(path, joints)
    q = states(len(joints))[0]
    pose, jacobian = tip.pose(q), tip.jacobian(q)
    assert pose.shape == (2, 5, 4, 4)
    assert jacobian.shape == (2, 5, 6, len(joints))
    torch.testing.assert_close(tip.position(q), pose[..., :3, 3])
    frame = dynamics.model.getFrameId(tip.link)
    for at, found, slope in zip(q.flatten(0, 1), pose.flatten(0, 1), jacobian.flatten(0, 1), strict=True):
        at_joints = dynamics.configuration(at.numpy())
        by_joint = pin.computeFrameJacobian(
            dynamics.model, dynamics.data, at_joints, frame, pin.LOCAL_WORLD_ALIGNED
        )
        pin.framesForwardKinematics(dynamics.model, dynamics.data, at_joints)
        np.testing.assert_allclose(found, dynamics.data.oMf[frame].homogeneous, atol=1e-13)
        np.testing.assert_allclose(slope, by_joint @ dynamics.jacobian, atol=1e-12)
