"""The rigid-body engine against Pinocchio's own reading of the URDF, and against mechanics done by hand."""

from fractions import Fraction

import numpy as np
import pinocchio as pin
import pytest

from spelgen.arm.arm import make_arm
from spelgen.dynamics.pinocchio_arm import arm_dynamics, pinocchio_model
from spelgen.errors import ArmError, SpelgenErrors
from spelgen.settings.joint import JointSettings
from spelgen.settings.settings import Settings, load_settings
from spelgen.urdf.read import read_urdf
from tests.hand_built import SIDEWAYS, arm, body, coordinate, point, slider

SIX = ("two_link", "rpr", "six_dof", "scara", "panda", "ur10e")


@pytest.mark.parametrize("robot", SIX)
def test_an_arm_is_what_pinocchio_reads_from_the_file(robot, robots):
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
    """Stage 2 slides twice as far on stage 1 as that on the base: v2 = 3 v1, M = m1 + 9 m2."""
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
    """Both points at length L, the elbow at -q/2 + 0.3, so that the second rod stands at b = q/2 + 0.3:

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
    assert str(error.value) == "joint 'a': its link has no inertial\njoint 'b': its link has no inertial"
    assert all(isinstance(each, ArmError) for each in error.value.errors)
