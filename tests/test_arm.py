"""`make_arm` makes the joint frames and bodies of a URDF, in rational numbers; its dynamics equal Pinocchio's."""

import json
import re
from fractions import Fraction
from math import cos, pi, sin

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from spelgen.arm.arm import make_arm
from spelgen.arm.rational import (
    IDENTITY,
    alignment,
    exact_rotation,
    rotation_about,
    rotation_from_rpy,
    rounded_angle,
)
from spelgen.errors import ArmError
from spelgen.urdf.read import read_urdf

pin = pytest.importorskip("pinocchio")

INERTIAL = (
    '<inertial><mass value="2"/><origin xyz="0.1 0.02 0.03" rpy="0.1 0.2 0.3"/>'
    '<inertia ixx="0.03" ixy="0.001" ixz="0.002" iyy="0.04" iyz="0.003" izz="0.05"/></inertial>'
)


def joint(name, parent, child, kind="revolute", xyz="0 0 0.3", rpy="0 0 0", axis="0 0 1", inside=""):
    limit = '<limit lower="-1" upper="2" effort="3" velocity="4"/>'
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{xyz}" rpy="{rpy}"/><axis xyz="{axis}"/>{limit}{inside}</joint>'
    )


@pytest.fixture
def robot(tmp_path):
    """Return a function that reads a robot with the given joint elements and with all links that these joints name.

    The links have equal inertials, except links in `bare`, which have none.
    """

    def make(*joints, bare=()):
        text = "".join(joints)
        names = list(dict.fromkeys(re.findall(r'link="([^"]*)"', text)))
        links = "".join(f'<link name="{n}">{"" if n in bare else INERTIAL}</link>' for n in names)
        path = tmp_path / "robot.urdf"
        path.write_text(f'<robot name="r">{links}{text}</robot>')
        return read_urdf(path)

    return make


def names(arm):
    return [coordinate.name for coordinate in arm.coordinates]


def exact(body):
    """Return the rotation of a body as a (3, 3) array of fractions."""
    return np.array(body.rotation)


def codes(arm):
    return [diagnostic.code for diagnostic in arm.diagnostics]


class TestChain:
    def test_longest_chain_is_taken_and_the_rest_locked(self, robot):
        arm = make_arm(robot(joint("a", "0", "1"), joint("b", "1", "2"), joint("side", "0", "3")))
        assert names(arm) == ["a", "b"]
        assert arm.locked == ("side",)
        assert "locked-joint" in codes(arm)

    def test_joints_outside_the_chain_are_one_remark(self, robot):
        sides = [joint(f"side{k}", "0", f"s{k}") for k in range(9)]
        arm = make_arm(robot(joint("a", "0", "1"), joint("b", "1", "2"), *sides))
        (remark,) = [diagnostic for diagnostic in arm.diagnostics if diagnostic.code == "locked-joint"]
        assert all(repr(f"side{k}") in remark.message for k in range(9))

    def test_tips_behind_fixed_joints_are_one_chain(self, robot):
        tips = joint("t", "1", "tool", "fixed"), joint("f", "1", "flange", "fixed")
        assert names(make_arm(robot(joint("a", "0", "1"), *tips))) == ["a"]

    def test_gripper_joints_by_name_are_no_coordinates(self, robot):
        jaws = joint("gripper_left", "1", "l", "prismatic"), joint("my_finger", "1", "r", "prismatic")
        assert names(make_arm(robot(joint("a", "0", "1"), *jaws))) == ["a"]

    def test_a_last_joint_that_may_open_a_gripper_is_stated_with_the_tip_that_leaves_it_out(self, robot):
        """If the last link has a gripper's name, the remark `ambiguous-chain` advises the link before it as --tip."""
        arm = robot(joint("a", "0", "1"), joint("b", "1", "gripper_moving_part"))
        assert names(make_arm(arm)) == ["a", "b"]
        (remark,) = [x for x in make_arm(arm).diagnostics if x.code == "ambiguous-chain"]
        assert "'--tip 1'" in remark.message
        assert names(make_arm(arm, tip="1")) == ["a"]
        assert "ambiguous-chain" not in codes(make_arm(arm, joints=["a", "b"]))
        jaw = joint("a", "0", "1"), joint("b", "1", "gripper"), joint("jaw", "gripper", "2")
        assert "ambiguous-chain" not in codes(make_arm(robot(*jaw)))

    def test_a_finger_robot_keeps_its_joints(self, robot):
        assert names(make_arm(robot(joint("finger_1", "0", "1"), joint("finger_2", "1", "2")))) == [
            "finger_1",
            "finger_2",
        ]

    @pytest.mark.parametrize("kind, mimic", [("prismatic", ""), ("prismatic", "j7"), ("revolute", "j7")])
    def test_two_jaws_side_by_side_at_the_end_are_a_gripper_or_stated(self, robot, kind, mimic):
        jaw = joint("j8", "1", "r", kind, inside=mimic and f'<mimic joint="{mimic}"/>')
        arm = make_arm(robot(joint("a", "0", "1"), joint("j7", "1", "l", kind), jaw))
        assert names(arm) == (["a"] if kind == "prismatic" else ["a", "j7"])
        assert "ambiguous-chain" in codes(arm)

    def test_a_last_joint_that_fingers_elsewhere_follow_is_stated(self, robot):
        """A last joint that other joints mimic may drive a gripper: the remark advises the link before it as --tip."""
        drive = joint("drive", "palm", "l").replace('lower="-1" upper="2"', 'lower="0" upper="0.8"')
        followers = [joint("m1", "palm", "r", inside='<mimic joint="drive" multiplier="-1"/>')]
        followers += [joint("m2", "l", "t", inside='<mimic joint="drive"/>')]
        arm = make_arm(robot(joint("a", "0", "palm"), drive, *followers))
        (remark,) = [x for x in arm.diagnostics if x.code == "ambiguous-chain"]
        assert "'--tip palm'" in remark.message

    @pytest.mark.parametrize("lower, is_outside", [("0.5", True), ("-0.5", False)])
    def test_a_joint_locked_outside_its_limits_is_stated(self, robot, lower, is_outside):
        outer = joint("b", "1", "2").replace('lower="-1"', f'lower="{lower}"')
        arm = make_arm(robot(joint("a", "0", "1"), outer), joints=["a"])
        assert any("'b' (0 is outside its limits)" in x.message for x in arm.diagnostics) == is_outside

    @pytest.mark.parametrize("travel", [0.04, 0.4])
    def test_a_short_slide_at_the_end_may_open_a_gripper(self, robot, travel):
        slide = joint("b", "1", "2", "prismatic")
        slide = re.sub('lower="[^"]*" upper="[^"]*"', f'lower="0" upper="{travel}"', slide)
        arm = make_arm(robot(joint("a", "0", "1"), slide))
        assert names(arm) == ["a", "b"]
        assert ("ambiguous-chain" in codes(arm)) == (travel < 0.1)

    def test_a_joint_of_effort_zero_decides_between_equal_chains(self, robot):
        spring = joint("spring", "1", "s").replace('effort="3"', 'effort="0"')
        arm = make_arm(robot(joint("a", "0", "1"), spring, joint("b", "1", "2")))
        assert names(arm) == ["a", "b"]
        assert "ambiguous-chain" in codes(arm)

    def test_named_joints_and_a_tip_lock_all_other_joints(self, robot):
        two = robot(joint("a", "0", "1"), joint("b", "1", "2"), joint("c", "2", "3"))
        arm = make_arm(two, joints=["a", "c"])
        assert names(arm) == ["a", "c"]
        assert arm.locked == ("b",)
        assert names(make_arm(two, tip="2")) == ["a", "b"]

    @pytest.mark.parametrize(
        ("choice", "message"),
        [
            (
                {},
                "FILE: got 2 chains of 1 joint: one to the link '1' (a ... a) and one to the link '2' "
                "(b ... b), "
                "expected one longest chain; choose one with --tip LINK or --joints A,B,..., "
                "or write tip or moving_joints into the settings",
            ),
            ({"joints": ["aa"]}, "FILE: no joint is named 'aa'; did you mean 'a'?"),
            (
                {"joints": ["fix"]},
                "FILE:1: joint 'fix': got a fixed joint, expected a revolute, continuous or prismatic joint",
            ),
            (
                {"joints": ["m"]},
                "FILE:1: joint 'm': got a mimic joint, expected its leader; name 'a' instead: "
                "its mimic joints move with it",
            ),
            ({"joints": ["a", "a"]}, "FILE: got the joint 'a' twice, expected each joint once"),
            (
                {"joints": ["a", "b"]},
                "FILE:1: got the joints 'b' and 'a', which lie on different branches, "
                "expected joints on one path from the root",
            ),
            (
                {"joints": []},
                "FILE: got no joint that moves independently, expected a serial chain of joints",
            ),
            ({"tip": "9"}, "FILE: no link is named '9'; known are '0', '1', '2', '3', '4'"),
            ({"tip": "0"}, "FILE: got no joint that moves independently, expected a serial chain of joints"),
            ({"tip": "1", "joints": ["a"]}, "FILE: got both joints and a tip, expected one of the two"),
            (
                {"tip": "1", "angle_tolerance": -1},
                "got an angle tolerance of -1 rad, expected at least 0 and less than pi/4 (0.785)",
            ),
        ],
    )
    def test_invalid_choices_of_joints_are_refused(self, robot, choice, message):
        made = robot(
            joint("a", "0", "1"),
            joint("b", "0", "2"),
            joint("fix", "0", "3", "fixed"),
            joint("m", "0", "4", inside='<mimic joint="a"/>'),
        )
        with pytest.raises(ArmError) as told:
            make_arm(made, **choice)
        assert str(told.value).replace(str(made.path), "FILE") == message

    def test_wrong_order_is_refused_with_the_right_one(self, robot):
        with pytest.raises(ArmError, match="expected the order from the root to the tip; use a,b"):
            make_arm(robot(joint("a", "0", "1"), joint("b", "1", "2")), joints=["b", "a"])

    @pytest.mark.parametrize("kind", ["floating", "planar"])
    def test_a_free_joint_within_the_chain_is_refused_and_another_one_held(self, robot, kind):
        free = joint("f", "1", "2", kind)
        with pytest.raises(ArmError, match=f"got a {kind} joint on the way to the joint 'b'"):
            make_arm(robot(joint("a", "0", "1"), free, joint("b", "2", "3")))
        arm = make_arm(robot(joint("f", "0", "1", kind), joint("a", "1", "2")))
        assert (arm.joint_names, arm.locked) == (("a",), ("f",))
        assert [x.message for x in arm.diagnostics if x.code == "locked-joint"] == [
            f"a {kind} joint that is not part of the chain: fixed at its origin"
        ]
        arm = make_arm(robot(joint("a", "0", "2"), joint("f", "2", "1", "floating")))
        assert arm.locked == ("f",)


class TestCoordinates:
    def test_limits_and_friction_are_those_of_the_file(self, robot):
        dynamics = '<dynamics damping="0.5" friction="0.25"/>'
        arm = make_arm(robot(joint("a", "0", "1", "continuous", inside=dynamics), joint("b", "1", "2")))
        first, second = arm.coordinates
        assert (first.joint_type, first.continuous, first.lower, first.effort) == (
            "revolute",
            True,
            None,
            3.0,
        )
        assert (first.damping, first.friction, first.passive) == (0.5, 0.25, False)
        assert (second.continuous, second.lower, second.upper, second.velocity) == (False, -1.0, 2.0, 4.0)

    def test_reversed_limits_are_the_same_range(self, robot):
        reversed_limits = joint("a", "0", "1").replace('lower="-1" upper="2"', 'lower="2" upper="-1"')
        assert (
            make_arm(robot(reversed_limits)).coordinates == make_arm(robot(joint("a", "0", "1"))).coordinates
        )


class TestMimic:
    def test_a_mimic_chain_moves_with_its_first_leader(self, robot):
        arm = make_arm(
            robot(
                joint("a", "0", "1"),
                joint("b", "1", "2", inside='<mimic joint="a" multiplier="-0.5" offset="0.1"/>'),
                joint("c", "2", "3", "prismatic", inside='<mimic joint="b" multiplier="3" offset="1"/>'),
            )
        )
        assert names(arm) == ["a"]
        assert [(b.name, b.coordinate, b.multiplier) for b in arm.bodies] == [
            ("a", 0, 1),
            ("b", 0, Fraction(-1, 2)),
            ("c", 0, Fraction(-3, 2)),
        ]
        assert [b.offset for b in arm.bodies] == [0.0, 0.1, 1.3]

    def test_chain_bodies_come_before_side_branches(self, robot):
        side = joint("s", "1", "4", inside='<mimic joint="b"/>')
        arm = make_arm(robot(joint("a", "0", "1"), side, joint("b", "1", "2")))
        assert [(body.name, body.parent) for body in arm.bodies] == [("a", -1), ("b", 0), ("s", 0)]

    def test_a_follower_of_a_locked_joint_is_held_at_its_offset(self, robot):
        made = robot(
            joint("a", "0", "1"),
            joint("locked", "1", "2"),
            joint("m", "1", "3", "prismatic", axis="1 0 0", inside='<mimic joint="locked" offset="0.25"/>'),
            joint("b", "3", "4"),
        )
        arm = make_arm(made, joints=["a", "b"])
        assert arm.locked == ("locked", "m")
        assert arm.bodies[1].translation == (Fraction(1, 4), 0, Fraction(3, 5))


class TestSnapping:
    @pytest.mark.parametrize(
        ("angle", "meant"),
        [
            (1.57, pi / 2),
            (-3.14, -pi),
            (1.5708, pi / 2),
            (6.2832, 2 * pi),
            (0.7854, pi / 4),
            (0.2618, pi / 12),
            (0.392699, pi / 8),
            (0.62832, pi / 5),
            (0.001, 0.0),
            (0.35, 0.35),
            (1.55, 1.55),
            (0.7853, 0.7853),
        ],
    )
    def test_angles(self, angle, meant):
        assert rounded_angle(angle, 2e-3) == meant
        assert rounded_angle(angle, 0.0) == angle

    def test_snapped_values_are_reported_once_per_joint(self, robot):
        rounded = joint("a", "0", "1", xyz="1e-12 0 0.3", rpy="1.5708 0 -3.1416", axis="0.0001 0 1")
        made = robot(rounded)
        arm = make_arm(made)
        told = {each.code: (each.severity, each.where, each.message) for each in arm.diagnostics}
        assert told == {
            "snapped-offset": ("info", "joint 'a' origin", "(1e-12, 0, 0.3) m is taken as (0, 0, 0.3)"),
            "snapped-angle": (
                "info",
                "joint 'a' origin",
                "1.5708 is taken as pi/2; -3.1416 is taken as -pi",
            ),
            "snapped-axis": ("info", "joint 'a' axis", "(0.0001, 0, 1) is taken as (0, 0, 1)"),
        }
        assert codes(make_arm(made, angle_tolerance=0.0)) == []

    def test_rounding_errors_in_a_tensor_are_no_products_of_inertia(self, robot):
        made = robot(joint("a", "0", "1"), bare=("0",))
        tensor = '<inertia ixx="1e-4" ixy="1e-20" ixz="1e-9" iyy="1e-4" iyz="0" izz="1e-4"/>'
        noisy = f'<inertial><mass value="1"/>{tensor}</inertial>'
        made.path.write_text(made.path.read_text().replace(INERTIAL, noisy))
        arm = make_arm(read_urdf(made.path))
        assert arm.bodies[0].inertia[5:7] == (0, Fraction(1, 10**9))
        assert codes(arm) == ["snapped-inertia"]
        assert make_arm(read_urdf(made.path), angle_tolerance=0.0).bodies[0].inertia[5] == Fraction(1, 10**20)

    def test_full_precision_is_not_reported(self, robot):
        assert codes(make_arm(robot(joint("a", "0", "1", rpy=f"{pi / 2} 0 1.57079632679")))) == []


class TestExactness:
    def test_quarter_turns_are_signed_permutations(self, robot):
        arm = make_arm(robot(joint("a", "0", "1"), joint("b", "1", "2", rpy="1.5708 0 0", axis="-1 0 0")))
        assert {entry for body in arm.bodies for row in body.rotation for entry in row} == {0, 1, -1}

    def test_two_halves_around_a_slider_are_exactly_a_quarter_turn(self, robot):
        arm = make_arm(
            robot(
                joint("a", "0", "1"),
                joint("s", "1", "2", "prismatic", rpy="0.785398 0 0"),
                joint("b", "2", "3", rpy="0.785398 0 0"),
            )
        )
        slider, last = arm.bodies[1:]
        assert 0 < slider.rotation[1][1] < 1
        assert (exact(slider) @ exact(last) == [[1, 0, 0], [0, 0, -1], [0, 1, 0]]).all()

    def test_a_lumped_frame_behind_a_slider_composes_exactly(self, robot):
        arm = make_arm(
            robot(
                joint("a", "0", "1"),
                joint("s", "1", "2", "prismatic", rpy="0.785398 0 0"),
                joint("f", "2", "3", "fixed", xyz="0 0 0", rpy="-0.785398 0 0"),
                joint("b", "3", "4", xyz="0 0 1"),
            )
        )
        # The fixed joint reverses the tilt of the slider: joint "b" is one metre along the z axis of joint "a". In the
        # frame of the slider, with the rotation R relative to joint "a", this axis is row 2 of R.
        slider, last = arm.bodies[1:]
        assert last.translation == slider.rotation[2]
        assert (exact(slider) @ exact(last) == IDENTITY).all()

    def test_every_rotation_of_every_arm_is_exactly_orthogonal(self, shared):
        for name, expected in expectations(shared).items():
            for body in arm_of(shared, name, joints=expected["joints"]).bodies:
                assert (exact(body) @ exact(body).T == IDENTITY).all()
                assert determinant(body.rotation) == 1

    @given(
        st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda a: np.linalg.norm(a) > 0.1),
        st.floats(-pi, pi),
    )
    @settings(max_examples=200, deadline=None)
    def test_any_rotation_is_approximated_to_1e_11(self, axis, angle):
        rotation = rotation_about(np.array(axis) / np.linalg.norm(axis), angle)
        found = exact_rotation(rotation)
        assert (found @ found.T == IDENTITY).all()
        assert np.abs(np.array(found, dtype=float) - rotation).max() < 1e-11

    def test_without_rounding_angles_are_those_of_the_file(self, robot):
        """With an angle tolerance of zero the rotation is the file's 1.57079632679 rad, not rounded to pi/2."""
        made = robot(joint("a", "0", "1", rpy="0.3 1.57079632679 0", axis="0 0 1"))
        (body,) = make_arm(made, angle_tolerance=0.0).bodies
        expected = rotation_from_rpy((0.3, 1.57079632679, 0.0))
        assert np.abs(np.array(exact(body), dtype=float) - expected).max() < 1e-15

    @given(st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda a: np.linalg.norm(a) > 0.1))
    @settings(max_examples=100, deadline=None)
    def test_alignment_takes_z_to_the_axis(self, axis):
        unit = np.array(axis) / np.linalg.norm(axis)
        turned = alignment(unit)
        assert np.allclose(turned[:, 2], unit, atol=1e-15)
        assert np.allclose(turned @ turned.T, np.eye(3), atol=1e-14)
        assert np.linalg.det(turned) == pytest.approx(1)

    def test_inertias_are_exact_decimals(self, robot):
        made = robot(joint("a", "0", "1"), bare=("0",))
        plain = INERTIAL.replace('rpy="0.1 0.2 0.3"', 'rpy="0 0 1.5708"')
        made.path.write_text(made.path.read_text().replace(INERTIAL, plain))
        mass, hx, hy, hz, xx, xy, *_ = make_arm(read_urdf(made.path)).bodies[0].inertia
        x, y, z = Fraction(1, 10), Fraction(2, 100), Fraction(3, 100)
        assert (mass, hx, hy, hz) == (2, 2 * x, 2 * y, 2 * z)
        # the inertial frame is rotated by a quarter turn about z: ixx and iyy are exchanged, ixy changes its sign
        assert xx == Fraction(4, 100) + 2 * (y * y + z * z)
        assert xy == -Fraction(1, 1000) - 2 * x * y


class TestLumping:
    def test_fixed_and_locked_links_are_lumped_and_reported(self, robot):
        made = robot(
            joint("a", "0", "1"),
            joint("f", "1", "2", "fixed"),
            joint("locked", "2", "3"),
            joint("b", "1", "4"),
        )
        arm = make_arm(made, joints=["a", "b"])
        assert [body.inertia[0] for body in arm.bodies] == [6, 2]
        lumped = next(each for each in arm.diagnostics if each.code == "lumped")
        assert lumped.message == "also carries '2', '3' (4 kg) by fixed or locked joints"

    def test_inertials_are_complete_if_every_body_has_mass(self, robot):
        joints = joint("a", "0", "1"), joint("b", "1", "2")
        assert make_arm(robot(*joints)).inertials_complete
        bare = make_arm(robot(*joints, bare=("2",)))
        assert bare.bodies[1].inertia is None
        assert not bare.inertials_complete

    def test_a_parallel_branch_without_mimic_is_warned_of_once(self, robot):
        branch = joint("c", "1", "3", xyz="0.1 0 0"), joint("d", "3", "4")
        tip = joint("e", "2", "5"), joint("g", "5", "6")
        arm = make_arm(robot(joint("a", "0", "1"), joint("b", "1", "2"), *tip, *branch))
        told = [each.where for each in arm.diagnostics if each.code == "dependent-joints"]
        assert told == ["joint 'c'"]


class TestAgainstPinocchio:
    """At random positions, joint frames, M and gravity torques equal Pinocchio's, which reads the same URDF."""

    def test_all_reference_arms_move_and_weigh_the_same(self, shared):
        rng = np.random.default_rng(0)
        compared = 0
        for name, expected in expectations(shared).items():
            path = shared / "arms" / f"{name}.urdf"
            arm = arm_of(shared, name, joints=expected["joints"], angle_tolerance=0.0)
            try:
                theirs = Theirs(path, arm)
            except ValueError:
                continue  # Pinocchio rejects a few files: a limit has no effort, or friction is negative
            ours = Ours(arm)
            for _ in range(3):
                q = rng.uniform(-2, 2, len(arm.coordinates))
                assert_close(ours.origins(q), theirs.origins(q), name)
                assert_close(ours.axes(q), theirs.axes(q), name)
                if all(body.inertia for body in arm.bodies):
                    assert_close(ours.mass_matrix(q), theirs.mass_matrix(q), name)
                    assert_close(ours.gravity(q), theirs.gravity(q), name)
            compared += 1
        assert compared > 180


def assert_close(ours, theirs, name):
    scale = max(1.0, np.abs(theirs).max())
    assert np.abs(ours - theirs).max() < 1e-9 * scale, name


class Ours:
    """Pinocchio model that is assembled from the joints and bodies of an arm as `make_arm` has derived them.

    Pinocchio does not read the URDF here (see `Theirs`).
    """

    def __init__(self, arm):
        self.model = pin.Model()
        for body in arm.bodies:
            kind = pin.JointModelRZ() if body.joint_type == "revolute" else pin.JointModelPZ()
            pose = pin.SE3(np.array(body.rotation, dtype=float), np.array(body.translation, dtype=float))
            index = self.model.addJoint(body.parent + 1, kind, pose, body.name)
            if body.inertia is not None:
                m, hx, hy, hz, xx, xy, xz, yy, yz, zz = (float(x) for x in body.inertia)
                ten = np.array([m, hx, hy, hz, xx, xy, yy, xz, yz, zz])
                inertia = pin.Inertia.FromDynamicParameters(ten)
                self.model.appendBodyToJoint(index, inertia, pin.SE3.Identity())
        self.model.gravity.linear = np.array([float(x) for x in arm.gravity])
        self.data = self.model.createData()
        self.slope = np.zeros((len(arm.bodies), len(arm.coordinates)))
        for row, body in enumerate(arm.bodies):
            self.slope[row, body.coordinate] = body.multiplier
        self.offset = np.array([body.offset for body in arm.bodies])

    def placed(self, q):
        pin.forwardKinematics(self.model, self.data, self.slope @ q + self.offset)
        return [self.data.oMi[i] for i in range(1, self.model.njoints)]

    def origins(self, q):
        return np.array([pose.translation for pose in self.placed(q)])

    def axes(self, q):
        return np.array([pose.rotation[:, 2] for pose in self.placed(q)])

    def mass_matrix(self, q):
        upper = pin.crba(self.model, self.data, self.slope @ q + self.offset)
        full = np.triu(upper) + np.triu(upper, 1).T
        return self.slope.T @ full @ self.slope

    def gravity(self, q):
        at = self.slope @ q + self.offset
        return self.slope.T @ pin.computeGeneralizedGravity(self.model, self.data, at)


class Theirs:
    """Pinocchio's own model of the URDF, in which mimic joints and locked joints are independent joints, too.

    Its joint positions are slope q + offset, with the arm's coordinates q; locked joints are at zero.
    """

    def __init__(self, path, arm):
        text = re.sub(r"<\?xml[^>]*\?>", "", path.read_text(encoding="utf-8"), count=1)
        self.model = pin.buildModelFromXML(text)
        self.data = self.model.createData()
        self.bodies = [body.name for body in arm.bodies]
        robot = read_urdf(path)
        self.local_axes = [
            np.array(robot.joint[n].axis) / np.linalg.norm(robot.joint[n].axis) for n in self.bodies
        ]
        self.slope = np.zeros((self.model.nv, len(arm.coordinates)))
        self.offset = np.zeros(self.model.nv)
        position = {coordinate.name: i for i, coordinate in enumerate(arm.coordinates)}
        for joint in robot.joints:
            if joint.type not in ("revolute", "continuous", "prismatic"):
                continue
            leader, multiplier, offset = joint, 1.0, 0.0
            while leader.mimic:
                offset += multiplier * leader.mimic.offset
                multiplier *= leader.mimic.multiplier
                leader = robot.joint[leader.mimic.joint]
            row = self.model.joints[self.model.getJointId(joint.name)].idx_v
            self.offset[row] = offset
            if leader.name in position:
                self.slope[row, position[leader.name]] = multiplier

    def configuration(self, q):
        values = self.slope @ q + self.offset
        full = pin.neutral(self.model)
        for model in list(self.model.joints)[1:]:
            if model.nv != 1:
                continue
            value = values[model.idx_v]
            entry = [value] if model.nq == 1 else [cos(value), sin(value)]
            full[model.idx_q : model.idx_q + model.nq] = entry
        return full

    def placed(self, q):
        pin.forwardKinematics(self.model, self.data, self.configuration(q))
        return [self.data.oMi[self.model.getJointId(name)] for name in self.bodies]

    def origins(self, q):
        return np.array([pose.translation for pose in self.placed(q)])

    def axes(self, q):
        pairs = zip(self.placed(q), self.local_axes, strict=True)
        return np.array([pose.rotation @ axis for pose, axis in pairs])

    def mass_matrix(self, q):
        upper = pin.crba(self.model, self.data, self.configuration(q))
        full = np.triu(upper) + np.triu(upper, 1).T
        return self.slope.T @ full @ self.slope

    def gravity(self, q):
        return self.slope.T @ pin.computeGeneralizedGravity(self.model, self.data, self.configuration(q))


def expectations(shared):
    return json.loads((shared / "arms" / "expected.json").read_text())


def arm_of(shared, name, **options):
    return make_arm(read_urdf(shared / "arms" / f"{name}.urdf"), **options)


def determinant(a):
    (x, y, z), b, c = a
    return x * (b[1] * c[2] - b[2] * c[1]) - y * (b[0] * c[2] - b[2] * c[0]) + z * (b[0] * c[1] - b[1] * c[0])


class TestReferenceArms:
    def test_named_chains_have_the_expected_followers_and_inertials(self, shared):
        for name, expected in expectations(shared).items():
            arm = arm_of(shared, name, joints=expected["joints"])
            assert names(arm) == expected["joints"]
            driven = sorted(body.name for body in arm.bodies if body.name not in expected["joints"])
            assert driven == sorted(expected["mimic_driven"])
            assert arm.inertials_complete == (expected["inertials"] is not None)

    def test_the_default_chain_is_the_expected_one(self, shared):
        """The default chain equals the chain in the reference data for all but three of 189 arms.

        Two of these robots have two equal arms, and one has a jaw whose name does not distinguish it from a wrist.
        """
        others = {}
        for name, expected in expectations(shared).items():
            try:
                found = names(arm_of(shared, name))
            except ArmError as error:
                others[name] = str(error).split(": ", 1)[1].split(" joints")[0]
            else:
                if found != expected["joints"]:
                    others[name] = found
        assert others == {
            "baxter_robosuite_right": "got 2 chains of 7",
            "koch_v1_1": ["joint_1", "joint_2", "joint_3", "joint_4", "joint_5", "joint_6"],
            "openarm_v10_bimanual_left": "got 2 chains of 7",
        }


def test_rpy_is_roll_then_pitch_then_yaw_about_fixed_axes():
    x, y, z = np.eye(3)
    roll, pitch, yaw = 0.3, -0.7, 1.1
    expected = rotation_about(z, yaw) @ rotation_about(y, pitch) @ rotation_about(x, roll)
    assert np.allclose(rotation_from_rpy((roll, pitch, yaw)), expected, atol=1e-15)


@pytest.mark.parametrize(("axis", "warned"), [("0 0 1", True), ("0 1 0", False)])
def test_an_opened_linkage_turns_in_one_plane_and_a_head_does_not(robot, axis, warned):
    torso, pan = joint("lift", "base", "torso", "prismatic"), joint("pan", "torso", "neck")
    arm = [joint("a1", "torso", "l1"), joint("a2", "l1", "l2", axis="1 0 0"), joint("a3", "l2", "l3")]
    made = make_arm(robot(torso, pan, joint("tilt", "neck", "head", axis=axis), *arm))
    assert names(made) == ["lift", "a1", "a2", "a3"]
    assert ("dependent-joints" in [x.code for x in made.diagnostics]) == warned
