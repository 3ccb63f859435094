"""28 malformed or uncommon URDF files are read correctly, or refused by a message that names the defect."""

import csv
import re

import pytest

from spelgen.arm.arm import make_arm
from spelgen.certificate.verify import verify
from spelgen.errors import SpelgenError
from spelgen.structure.structure import derive
from spelgen.urdf.read import read_urdf

# refused files, and a pattern that each line of the error must match
REFUSED = {
    "microtaur_rpy_4_numbers": r"origin rpy: got 4 numbers \('.*'\), expected three numbers",
    "spherical_joint_type": r":28: joint 'neck': got the type 'spherical', expected one of revolute, "
    "continuous",
    "r2_duplicate_link_two_parents": r"a second link of that name|which hangs from|no link is named",
    "fetch_unbound_xml_prefix": r":655: <sensor:camera>: got the prefix 'sensor', which nothing declares",
    "mycobot_merge_conflict": r":1: got a merge-conflict marker, expected XML; resolve the merge "
    "conflict first",
    "diffring_xml_decl_not_first": r":2: got text or blank lines before the XML declaration",
    "ur3_xacro_macro_named_urdf": r":6: <robot>: got no <link>, .*; this is a xacro file: expand it",
    "mycobot_missing_link": r":5: <xacro:include>: got xacro that was not expanded",
    "ultraarm_two_roots": r":2: <robot>: got 2 root links: 'env' \(line 6\), 'base' \(line 15\)",
    "quadrotor_namespaced_root": r":7: got <robot> in the namespace 'http://drake.mit.edu'",
}

# Accepted files, as {name: (joints, codes of the warnings of `read_urdf`, codes of the warnings of `make_arm`)}. The
# joints are of the default chain, with "_" for a space in a name.
READ = {
    "koch_limit_without_effort": (
        "joint_1 joint_2 joint_3 joint_4 joint_5 joint_6",
        set(),
        set(),
    ),
    "so100_link_joint_same_name": (
        "shoulder_pan shoulder_lift elbow_flex wrist_flex wrist_roll",
        set(),
        set(),
    ),
    "lwr4_negative_friction": (
        "lwr_0_joint lwr_1_joint lwr_2_joint lwr_3_joint lwr_4_joint lwr_5_joint lwr_6_joint",
        {"negative-friction", "triangle-inequality"},
        set(),
    ),
    "lwr4_inertial_without_inertia": (
        "lwr_a1_joint lwr_a2_joint lwr_e1_joint lwr_a3_joint lwr_a4_joint lwr_a5_joint lwr_a6_joint",
        {"inertial-without-inertia", "missing-inertial", "placeholder-inertial", "repeated-element"},
        {"ambiguous-chain", "dependent-joints"},
    ),
    "fingerpro_two_inertials": (
        "finger_base_to_upper_joint finger_upper_to_middle_joint finger_middle_to_lower_joint",
        {"repeated-element", "density"},
        set(),
    ),
    "wam7_nonPSD_inertia": (
        "wam/base_yaw_joint wam/shoulder_pitch_joint wam/shoulder_yaw_joint wam/elbow_pitch_joint "
        "wam/wrist_yaw_joint wam/wrist_pitch_joint wam/palm_yaw_joint",
        {"non-psd-inertia"},
        set(),
    ),
    "xarm6_triangle_violation": ("joint1 joint2 joint3 joint4 joint5 joint6", {"triangle-inequality"}, set()),
    "al5d_zero_inertia_tensors": ("j1 j2 j3 j4", {"zero-inertia"}, set()),
    "gen3lite_massless_last_body": ("J0 J1 J2 J3 J4 J5", {"missing-inertial"}, set()),
    "irb5400_mimic_in_chain": ("joint1 joint2 joint3 joint4 joint5 joint6", {"missing-inertial"}, set()),
    "irb6640_mimic_side_branch": (
        "joint_1 joint_2 joint_3 joint_4 joint_5 joint_6",
        {"missing-inertial"},
        set(),
    ),
    "scara_lower_gt_upper": (
        "base_to_link1 link1_to_link2 link2_to_link3 link3_to_link4",
        {"lower-above-upper", "missing-inertial"},
        set(),
    ),
    "threelinks_nonunit_axis": ("joint_1_2 joint_2_3", {"non-unit-axis", "placeholder-inertial"}, set()),
    "edo_axis_noise": ("joint_1 joint_2 joint_3 joint_4 joint_5 joint_6", {"placeholder-inertial"}, set()),
    "low_cost_arm_space_in_names": (
        "Revolute_2 Revolute_3 Revolute_5 Revolute_6 Revolute_7",
        set(),
        set(),
    ),
    "floating_joint_tip": ("part1 part2 part3 part4", {"zero-inertia"}, set()),
    "poppy_two_geometries": ("m1 m2 m3 m4 m5 m6", {"placeholder-inertial"}, set()),
    "mg400_opened_parallelogram": (
        "mg400_j1 mg400_j2_1 mg400_j3_1 mg400_j4_1 mg400_j5",
        set(),
        {"dependent-joints"},
    ),
}


# Five numbers per file: joints, varying terms of M (outputs), constant terms of M, joints that V depends on, and base
# parameters.
FACTS = {
    "koch_limit_without_effort": (6, 18, 3, 5, 36),
    "so100_link_joint_same_name": (5, 12, 3, 4, 29),
    "lwr4_negative_friction": (7, 27, 1, 6, 43),
    "lwr4_inertial_without_inertia": (7, 27, 1, 6, 43),
    "fingerpro_two_inertials": (3, 4, 2, 3, 17),
    "wam7_nonPSD_inertia": (7, 27, 1, 6, 43),
    "xarm6_triangle_violation": (6, 19, 2, 5, 36),
    "al5d_zero_inertia_tensors": (4, 7, 3, 3, 22),
    "gen3lite_massless_last_body": (6, 19, 2, 5, 36),
    "irb5400_mimic_in_chain": (6, 19, 2, 5, 43),
    "irb6640_mimic_side_branch": (6, 20, 1, 5, 44),
    "scara_lower_gt_upper": (4, 3, 4, 1, 8),
    "threelinks_nonunit_axis": (2, 2, 1, 1, 8),
    "edo_axis_noise": (6, 20, 1, 5, 36),
    "low_cost_arm_space_in_names": (5, 13, 2, 4, 29),
    "floating_joint_tip": (4, 6, 3, 3, 16),
    "poppy_two_geometries": (6, 18, 3, 5, 36),
    "mg400_opened_parallelogram": (5, 12, 3, 4, 29),
}


@pytest.fixture
def nasty(shared):
    return shared / "nasty"


def test_the_table_holds_every_file(nasty):
    with (nasty / "README.csv").open(newline="", encoding="utf-8") as table:
        files = {row["file"].removesuffix(".urdf") for row in csv.DictReader(table)}
    assert files == {*REFUSED, *READ}


@pytest.mark.parametrize("name", REFUSED)
def test_refused(nasty, name):
    with pytest.raises(SpelgenError) as told:
        read_urdf(nasty / f"{name}.urdf")
    for line in str(told.value).splitlines():
        assert line.startswith(str(nasty / f"{name}.urdf"))
        assert re.search(REFUSED[name], line)


@pytest.mark.parametrize("name", READ)
def test_read(nasty, name):
    joints, on_robot, on_arm = READ[name]
    robot = read_urdf(nasty / f"{name}.urdf")
    arm = make_arm(robot)
    assert [coordinate.name.replace(" ", "_") for coordinate in arm.coordinates] == joints.split()
    assert {each.code for each in robot.diagnostics if each.severity == "warning"} == on_robot
    assert {each.code for each in arm.diagnostics if each.severity == "warning"} == on_arm


@pytest.mark.parametrize("name", READ)
def test_accepted_files_are_read_correctly(nasty, name):
    """Accepted files have the known structure; numerical verification, Pinocchio and another URDF reader confirm it."""
    robot = read_urdf(nasty / f"{name}.urdf")
    arm = make_arm(robot)
    found = derive(arm)
    sizes = (found.joints, found.outputs, found.constants, found.potential)
    assert (*map(len, sizes), found.base_parameter_count) == FACTS[name]
    proof = verify(robot, arm, found)
    assert proof.agrees, proof.text()
