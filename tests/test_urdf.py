"""A URDF is read with its exact values, each defect is reported with its line, and external files are not opened."""

import hashlib
import re
import time

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from time_bounds import in_time

from spelgen.arm.arm import make_arm
from spelgen.arm.configured_arm import load_arm
from spelgen.errors import ArmError, SpelgenError
from spelgen.urdf.read import read_urdf
from spelgen.urdf.robot import Inertial, Mimic, Transmission, UrdfJoint

LINKS = '<link name="base"/>\n<link name="arm"/>\n'
JOINT = (
    '<joint name="j" type="revolute"><parent link="base"/><child link="arm"/>'
    '<limit lower="-1" upper="1" effort="2" velocity="3"/></joint>\n'
)
INERTIAL = (
    '<inertial><mass value="1"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1.5"/></inertial>'
)


@pytest.fixture
def write(tmp_path):
    """Return a function that writes the inside of a <robot>, or a whole document, and returns its path."""

    def make(inside, whole=False):
        path = tmp_path / "robot.urdf"
        data = inside if whole else f'<robot name="r">\n{inside}</robot>\n'
        path.write_bytes(data if isinstance(data, bytes) else data.encode())
        return path

    return make


def joint(inside="", *, name="j", kind="revolute", parent="base", child="arm"):
    """Return a joint of three lines, the second of which is ``inside``."""
    ends = f'<parent link="{parent}"/><child link="{child}"/>'
    limit = "" if "<limit" in inside else '<limit lower="-1" upper="1" effort="2" velocity="3"/>'
    return f'<joint name="{name}" type="{kind}">{ends}\n{inside}\n{limit}</joint>\n'


class TestValues:
    def test_a_joint_is_read_as_written(self, write):
        inside = (
            '<origin xyz="1 -2e-3 .5" rpy="1.57 0 -3.14"/><axis xyz="0 0 -2"/>'
            '<limit lower="-1.5" upper="2" effort="87" velocity="2.2"/><dynamics damping="0.7" '
            'friction="0.1"/>'
            '<mimic joint="lead" multiplier="-2" offset="0.5"/>'
        )
        text = LINKS + '<link name="tip"/>' + joint(inside) + joint(name="lead", parent="arm", child="tip")
        robot = read_urdf(write(text))
        assert robot.joints[0] == UrdfJoint(
            name="j",
            type="revolute",
            parent="base",
            child="arm",
            xyz=(1.0, -0.002, 0.5),
            rpy=(1.57, 0.0, -3.14),
            axis=(0.0, 0.0, -2.0),
            lower=-1.5,
            upper=2.0,
            effort=87.0,
            velocity=2.2,
            damping=0.7,
            friction=0.1,
            mimic=Mimic("lead", -2.0, 0.5),
            line=4,
        )
        assert (robot.root, robot.name) == ("base", "r")

    def test_absent_values_have_the_defaults_of_the_format(self, write):
        text = LINKS + '<joint name="j" type="continuous"><parent link="base"/><child link="arm"/></joint>'
        found = read_urdf(write(text)).joints[0]
        assert (found.xyz, found.rpy, found.axis) == ((0, 0, 0), (0, 0, 0), (1, 0, 0))
        assert (found.lower, found.upper, found.effort, found.velocity) == (None,) * 4
        assert (found.damping, found.friction, found.mimic) == (0.0, 0.0, None)

    def test_an_inertial_is_read_as_written(self, write):
        inertial = (
            '<inertial><origin xyz="0 0 1" rpy="0 1.57 0"/><mass value="3"/>'
            '<inertia ixx="1" ixy="2" ixz="3" iyy="4" iyz="5" izz="6"/></inertial>'
        )
        text = f'<link name="base"/><link name="arm">\n{inertial}</link>' + JOINT
        expected = Inertial(3.0, (0.0, 0.0, 1.0), (0.0, 1.57, 0.0), (1, 2, 3, 4, 5, 6), line=3)
        assert read_urdf(write(text)).links[1].inertial == expected

    def test_a_transmission_keeps_its_reductions(self, write):
        transmission = (
            '<transmission name="t"><type> transmission_interface/SimpleTransmission </type>'
            '<joint name="j"><mechanicalReduction>2</mechanicalReduction><offset>0.1</offset></joint>'
            '<actuator name="m"><mechanicalReduction>-50</mechanicalReduction></actuator></transmission>'
        )
        robot = read_urdf(write(LINKS + JOINT + transmission))
        kind = "transmission_interface/SimpleTransmission"
        assert robot.transmissions == (Transmission(kind, (("j", 2.0),), (-50.0,)),)

    def test_the_digest_is_that_of_the_bytes(self, write):
        path = write(LINKS + JOINT)
        assert read_urdf(path).digest == hashlib.sha256(path.read_bytes()).hexdigest()

    def test_a_link_and_a_joint_may_share_a_name(self, write):
        assert read_urdf(write(LINKS + joint(name="arm"))).joints[0].name == "arm"

    def test_a_robot_without_a_name_takes_the_files(self, write):
        robot = read_urdf(write(f"<robot>{LINKS}{JOINT}</robot>", whole=True))
        assert robot.name == "robot"
        assert "missing-robot-name" in [each.code for each in robot.diagnostics]

    def test_values_equal_those_of_yourdfpy(self, shared):
        """Limits, axes, mimic relations and masses equal the values of the URDF reader yourdfpy.

        Not compared: origins, which are matrices in yourdfpy, and absent inertias, for which it has 1.0.
        """
        yourdfpy = pytest.importorskip("yourdfpy")
        options = {"load_meshes": False, "build_scene_graph": False}
        for path in sorted((shared / "arms").glob("*.urdf"))[::5]:
            ours = read_urdf(path)
            theirs = yourdfpy.URDF.load(str(path), **options).robot
            for mine, their in zip(ours.joints, theirs.joints, strict=True):
                assert (mine.name, mine.type, mine.parent) == (their.name, their.type, their.parent)
                assert mine.axis == tuple(their.axis)
                if their.limit is not None and mine.type != "continuous":
                    for limit in ("lower", "upper", "effort", "velocity"):
                        value = getattr(mine, limit)
                        stated = getattr(their.limit, limit)
                        assert value == stated or (value is None and (not stated or stated >= 1e3))
                if mine.mimic is not None:
                    assert mine.mimic.joint == their.mimic.joint
                    assert mine.mimic.multiplier == their.mimic.multiplier
            for mine, their in zip(ours.links, theirs.links, strict=True):
                if mine.inertial is not None:
                    assert mine.inertial.mass == their.inertial.mass
                    assert mine.inertial.tensor[::3] == (
                        their.inertial.inertia[0, 0],
                        their.inertial.inertia[1, 1],
                    )


DOCUMENTS = {
    "empty": ("  \n", "FILE: got an empty file, expected a URDF document"),
    "not xml": (
        "joint1: 0.3\n",
        "FILE:1: not well-formed XML (Start tag expected, '<' not found); "
        "name the URDF: this is a file of another kind",
    ),
    "web page": (
        "\n<!DOCTYPE html><html></html>",
        "FILE: got a web page, expected a URDF document; download the file itself: 'Raw' on the page of a "
        "repository",
    ),
    "zip": (
        b"PK\3\4\0",
        "FILE: got a ZIP archive, expected a URDF document; unpack it, and name the URDF in it",
    ),
    "srdf": (
        '<robot name="r"><group name="arm"/></robot>',
        "FILE:1: <robot>: got no <link>, expected a tree of links and joints; this is an SRDF file: name the URDF "
        "that it belongs to",
    ),
    "cut off": (
        '<robot name="r">\n<link name="a">',
        "FILE:2: not well-formed XML (Premature end of data in tag link line 2)",
    ),
    "pointer of Git LFS": (
        "version https://git-lfs.github.com/spec/v1\nsize 3\n",
        "FILE: got a pointer of Git LFS, expected a URDF document; run 'git lfs pull' first",
    ),
    "merge conflict": (
        '<robot name="r">\n<<<<<<< HEAD\n</robot>',
        "FILE:2: got a merge-conflict marker, expected XML; resolve the merge conflict first",
    ),
    "late declaration": (
        '\n<?xml version="1.0"?>\n<robot name="r"/>',
        "FILE:2: got text or blank lines before the XML declaration, expected <?xml ...?> at the very "
        "start of the "
        "file; delete the text before it",
    ),
    "late declaration behind a byte order mark": (
        b'\xef\xbb\xbf\n<?xml version="1.0"?>\n<robot name="r"/>',
        "FILE:2: got text or blank lines before the XML declaration, expected <?xml ...?> at the very "
        "start of the file; delete the text before it",
    ),
    "unbound prefix": (
        '<robot name="r">\n<sensor:camera/></robot>',
        "FILE:2: <sensor:camera>: got the prefix 'sensor', which nothing declares, expected well-formed XML; "
        'add xmlns:sensor="..." to <robot>, or remove the prefix',
    ),
    "namespace": (
        '<robot name="r" xmlns="http://x"/>',
        "FILE:1: got <robot> in the namespace 'http://x', expected <robot> in no namespace; "
        'remove xmlns="http://x"',
    ),
    "other format": (
        "<mujoco/>",
        "FILE:1: got the root element <mujoco> of an MJCF file, which is out of scope, expected <robot>; "
        "take the URDF that its robot's maker publishes, or convert it, for example with the package "
        "mjcf-urdf-simple-converter",
    ),
    "entities": (
        '<?xml version="1.0"?>\n<!DOCTYPE robot [<!ENTITY a "b">]>\n<robot name="&a;"/>',
        "FILE:2: got a document type or entity declaration, expected plain XML; remove it: entities "
        "are never "
        "expanded",
    ),
    "entities in utf-16": (
        '<!DOCTYPE robot [<!ENTITY a "b">]>\n<robot name="&a;"/>'.encode("utf-16"),
        "FILE: got a document type or entity declaration, expected plain XML; remove it: entities are never "
        "expanded",
    ),
    "xacro macro": (
        '<robot name="r" xmlns:xacro="http://wiki.ros.org/xacro">\n<xacro:arm/></robot>',
        "FILE:2: <xacro:arm>: got xacro that was not expanded, expected plain URDF; "
        "expand the file with the xacro command first",
    ),
    "only xacro": (
        '<robot xmlns:xacro="http://wiki.ros.org/xacro"/>',
        "FILE:1: <robot>: got no <link>, expected a tree of links and joints; this is a xacro file: "
        "expand it with "
        "the xacro command first",
    ),
}

CONTENTS = {
    "no joint": ('<link name="a"/>', "FILE:1: <robot>: got no <joint>, expected a tree of links and joints"),
    "nameless link": (
        LINKS + "<link/>" + JOINT,
        'FILE:4: <link>: got no name, expected a name; add name="..."',
    ),
    "empty name": (
        LINKS + '<link name=" "/>' + JOINT,
        'FILE:4: <link>: got an empty name, expected a name; add name="..."',
    ),
    "long name": (
        LINKS + f'<link name="{"n" * 300}"/>' + JOINT,
        "FILE:4: <link>: got a name of 300 characters, expected at most 256",
    ),
    "two links of a name": (
        LINKS + '<link name="arm"/>' + JOINT,
        "FILE:4: link 'arm': got a second link of that name (the first is in line 3), expected unique names; "
        "rename or remove one",
    ),
    "two parents": (
        LINKS + JOINT + joint(name="k"),
        "FILE:5: joint 'k' child: got the link 'arm', which hangs from 'j' (line 4) already, expected "
        "one parent per "
        "link; loops are out of URDF's scope: open them and add <mimic>",
    ),
    "missing link": (
        LINKS + joint(child="arn"),
        "FILE:4: joint 'j' child: no link is named 'arn'; did you mean 'arm'?",
    ),
    "two roots": (
        LINKS + '<link name="world"/>' + JOINT,
        "FILE:1: <robot>: got 2 root links: 'base' (line 2), 'world' (line 4), expected one link that "
        "is no joint's "
        "child; join the trees by a fixed joint",
    ),
    "circle": (
        LINKS + JOINT + joint(name="k", parent="arm", child="base"),
        "FILE:1: <robot>: got no root link: the joints form a circle, expected one link that is no "
        "joint's child; loops are out of URDF's scope: open them and add <mimic>",
    ),
    "circle beside the tree": (
        LINKS
        + JOINT
        + '<link name="x"/>\n<link name="y"/>'
        + joint(name="k", parent="x", child="y")
        + joint(name="l", parent="y", child="x"),
        "FILE:5: link 'x': got a circle of joints that never meets the root 'base', expected a tree; loops are out "
        "of URDF's scope: open them and add <mimic>\n"
        "FILE:6: link 'y': got a circle of joints that never meets the root 'base', expected a tree; loops are out "
        "of URDF's scope: open them and add <mimic>",
    ),
    "no type": (
        LINKS + JOINT.replace(' type="revolute"', ""),
        "FILE:4: joint 'j': got no type, expected one of revolute, continuous, prismatic, fixed, "
        "floating, planar",
    ),
    "spherical": (
        LINKS + joint(kind="spherical"),
        "FILE:4: joint 'j': got the type 'spherical', expected one of revolute, continuous, prismatic, "
        "fixed, "
        "floating, planar",
    ),
    "no child": (
        LINKS + JOINT.replace('<child link="arm"/>', ""),
        "FILE:4: joint 'j': got 0 <child> elements, expected one <child link=\"...\"/>",
    ),
    "four numbers": (
        LINKS + joint('<origin rpy="0 0 0 0"/>'),
        "FILE:5: joint 'j' origin rpy: got 4 numbers ('0 0 0 0'), expected three numbers",
    ),
    "commas": (
        LINKS + joint('<origin xyz="0, 0, 0"/>'),
        "FILE:5: joint 'j' origin xyz: got '0,', expected three numbers in decimal notation; write "
        "decimal points, and spaces between numbers",
    ),
    "quaternion": (
        LINKS + joint('<origin quat_xyzw="0 0 0 1"/>'),
        "FILE:5: joint 'j' origin quat_xyzw: got the attribute 'quat_xyzw', expected xyz [m] and rpy [rad]; "
        "convert the rotation to rpy",
    ),
    "not a number": (
        LINKS + joint('<origin xyz="0 nan 0"/>'),
        "FILE:5: joint 'j' origin xyz: got 'nan', expected three numbers in decimal notation",
    ),
    "overflow": (
        LINKS + joint('<limit lower="-1e999" upper="1" effort="1" velocity="1"/>'),
        "FILE:5: joint 'j' limit lower: got '-1e999', expected one number within the range of a float",
    ),
    "too far": (
        LINKS + joint('<origin xyz="0 0 1e13"/>'),
        "FILE:5: joint 'j' origin xyz: got '0 0 1e13', expected three numbers within +-1e+12",
    ),
    "overlong number": (
        LINKS + joint(f'<origin xyz="0 0 0.{"3" * 80}"/>'),
        "FILE:5: joint 'j' origin xyz: got a number of 82 characters, expected at most 64",
    ),
    "xacro expression": (
        LINKS + joint('<origin xyz="0 0 ${h}"/>'),
        "FILE:5: joint 'j' origin xyz: got the xacro expression '0 0 ${h}', expected a plain value; "
        "expand the file with the xacro command first",
    ),
    "zero axis": (
        LINKS + joint('<axis xyz="0 0 0"/>'),
        "FILE:5: joint 'j': got the axis '0 0 0', expected a direction; give the revolute joint an "
        "axis such as "
        '"0 0 1"',
    ),
    "unknown leader": (
        LINKS + joint('<mimic joint="i"/>'),
        "FILE:4: joint 'j' mimic: no joint is named 'i'; known are 'j'",
    ),
    "leader that is fixed": (
        LINKS
        + '<link name="tip"/>'
        + joint('<mimic joint="f"/>')
        + joint(name="f", kind="fixed", parent="arm", child="tip"),
        "FILE:4: joint 'j' mimic: got the fixed joint 'f', expected a revolute, continuous or "
        "prismatic joint to follow",
    ),
    "circle of leaders": (
        LINKS + joint('<mimic joint="j"/>'),
        "FILE:4: joint 'j' mimic: got a circle of mimic joints, expected a leader that moves by itself",
    ),
    "inertia without iyy": (
        f'<link name="base"/><link name="arm">{INERTIAL.replace("iyy=", "iy=")}</link>' + JOINT,
        "FILE:2: link 'arm' inertial inertia: got no iyy, expected ixx, ixy, ixz, iyy, iyz, izz [kg m2]",
    ),
    "axis as text": (
        LINKS + joint("<axis>0 0 1</axis>"),
        "FILE:5: joint 'j' axis: got text or elements inside it, expected only attributes; write its values as "
        "attributes",
    ),
    "axis as elements of SDF": (
        LINKS + joint("<axis><xyz>0 0 1</xyz></axis>"),
        "FILE:5: joint 'j' axis: got text or elements inside it, expected only attributes; write its values as "
        "attributes",
    ),
    "misspelt axis": (
        LINKS + joint('<Axis xyz="0 0 1"/>'),
        "FILE:5: joint 'j' axis: got the element <Axis>, expected <axis>; correct or remove it",
    ),
    "axis without direction": (
        LINKS + joint('<axis zyx="0 0 1"/>'),
        "FILE:5: joint 'j' axis: got no xyz, expected a direction; write <axis xyz=\"...\"/>",
    ),
    "misspelt origin": (
        LINKS + joint('<orgin xyz="0 0 1"/>'),
        "FILE:5: joint 'j' origin: got the element <orgin>, expected <origin>; correct or remove it",
    ),
    "pose of SDF": (
        LINKS + joint("<pose>0 0 1 0 0 0</pose>"),
        "FILE:5: joint 'j' origin: got the element <pose>, expected <origin>; correct or remove it",
    ),
    "misspelt multiplier": (
        LINKS
        + '<link name="tip"/>'
        + joint('<mimic joint="k" multipler="-1"/>')
        + joint(name="k", parent="arm", child="tip"),
        "FILE:5: joint 'j' mimic: got the attribute 'multipler', expected 'multiplier'; correct or remove it",
    ),
    "inertial in a namespace": (
        '<link name="base"/><link name="arm" xmlns:u="http://u"><u:inertial/></link>' + JOINT,
        "FILE:2: link 'arm' inertial: got the element <u:inertial>, expected <inertial>; correct or remove it",
    ),
    "capital product of inertia": (
        f'<link name="base"/><link name="arm">{INERTIAL.replace("ixy=", "Ixy=")}</link>' + JOINT,
        "FILE:2: link 'arm' inertial inertia: got the attribute 'Ixy', expected 'ixy'; correct or remove it",
    ),
    "everything is told once": (
        LINKS + joint('<origin rpy="0"/>') + joint(name="k", kind="ball", parent="arm", child="no"),
        "FILE:5: joint 'j' origin rpy: got 1 numbers ('0'), expected three numbers\n"
        "FILE:7: joint 'k': got the type 'ball', expected one of revolute, continuous, prismatic, "
        "fixed, floating, "
        "planar",
    ),
}


class TestRefusals:
    @pytest.mark.parametrize("case", DOCUMENTS)
    def test_files_that_are_no_urdf(self, write, case):
        document, message = DOCUMENTS[case]
        assert refusal(write(document, whole=True)) == message

    @pytest.mark.parametrize("case", CONTENTS)
    def test_files_that_are_no_robot(self, write, case):
        contents, message = CONTENTS[case]
        assert refusal(write(contents)) == message

    def test_a_missing_file_and_a_folder(self, tmp_path):
        assert refusal(tmp_path / "no.urdf") == "FILE: no such file"
        assert refusal(tmp_path) == "FILE: got no regular file, expected a URDF file"


class TestLint:
    @pytest.mark.parametrize(
        ("code", "text"),
        [
            ("negative-friction", LINKS + joint('<dynamics friction="-1"/>')),
            ("negative-friction", LINKS + joint('<dynamics damping="-1"/>')),
            ("non-unit-axis", LINKS + joint('<axis xyz="0 1 0.5"/>')),
            ("lower-above-upper", LINKS + joint('<limit lower="1" upper="0" effort="1" velocity="1"/>')),
            ("lower-above-upper", LINKS + joint('<limit lower="1" upper="1" effort="1" velocity="1"/>')),
            ("unlimited", LINKS + joint('<limit lower="0" upper="1"/>')),
            ("unusable-value", LINKS + JOINT.replace("<limit", "<limits")),
            ("unusable-value", LINKS + joint('<dynamics dampening="1"/>')),
            ("degrees", LINKS + joint('<origin rpy="0 5 0"/>')),
            ("degrees", LINKS + joint('<limit lower="-20" upper="20" effort="1" velocity="1"/>')),
            ("degrees", LINKS + joint('<origin rpy="0 90 0"/>')),
            ("degrees", LINKS + joint('<limit lower="-170" upper="170" effort="1" velocity="1"/>')),
            ("millimetres", LINKS + joint('<origin xyz="0 0 330"/>')),
            ("unlimited", LINKS + JOINT.replace("<limit", "<limits")),
            ("repeated-element", LINKS + joint('<axis xyz="0 0 1"/><axis xyz="0 1 0"/>')),
            ("missing-inertial", LINKS + JOINT),
            ("missing-inertial", f'<link name="base">{INERTIAL}</link><link name="arm"/>' + JOINT),
        ],
    )
    def test_joints(self, write, code, text):
        assert code in codes(write(text))

    @pytest.mark.parametrize(
        ("code", "inertial"),
        [
            ("negative-mass", INERTIAL.replace('"1"', '"-1"', 1)),
            ("massless-moving-link", INERTIAL.replace('"1"', '"0"', 1)),
            ("non-psd-inertia", INERTIAL.replace('ixy="0"', 'ixy="2"')),
            ("triangle-inequality", INERTIAL.replace("1.5", "3")),
            ("placeholder-inertial", INERTIAL.replace("1.5", "1.0")),
            ("zero-inertia", INERTIAL.replace("1.5", "0").replace('"1"', '"0"').replace('"0"', '"1"', 1)),
            ("inertial-without-inertia", '<inertial><mass value="1"/></inertial>'),
            ("inertial-without-mass", '<inertial><inertia ixx="1" iyy="1" izz="1"/></inertial>'),
            ("repeated-element", INERTIAL + INERTIAL),
            ("millimetres", INERTIAL.replace('"1"', '"0.001"', 1)),
            ("density", INERTIAL.replace('"1"', '"1e5"', 1).replace("1.5", "1").replace('="1"', '="1e-2"')),
            ("millimetres", INERTIAL.replace("<mass", '<origin xyz="0 -150 0"/><mass')),
        ],
    )
    def test_inertials(self, write, code, inertial):
        sound = f'<link name="base">{INERTIAL}</link><link name="arm">{INERTIAL}</link>'
        assert codes(write(sound + JOINT)) == []
        assert code in codes(write(f'<link name="base"/><link name="arm">{inertial}</link>' + JOINT))

    @pytest.mark.parametrize("tensors", [("1.5", "1.5", "1.5"), ("1.5", "1.6", "1.7")])
    def test_one_tensor_or_mass_on_most_links_is_a_placeholder(self, write, tensors):
        inertials = zip(("base", "arm", "tip"), tensors, strict=True)
        links = "".join(f'<link name="{name}">{INERTIAL.replace("1.5", x)}</link>' for name, x in inertials)
        text = links + JOINT + joint(name="k", parent="arm", child="tip")
        assert codes(write(text)) == ["placeholder-inertial"]

    def test_lines_and_messages(self, write):
        text = LINKS + joint('<axis xyz="0 1 0.5"/>')
        told = [each.to_dict() for each in read_urdf(write(text)).diagnostics]
        assert told[1] == {
            "severity": "warning",
            "code": "non-unit-axis",
            "where": "joint 'j' axis",
            "line": 4,
            "message": "its length is 1.11803: normalised",
        }

    def test_remaining_xacro_properties_are_reported(self, write):
        left = (
            '<robot name="r" xmlns:xacro="http://wiki.ros.org/xacro">\n<xacro:property name="a" value="1"/>'
        )
        assert "unexpanded-xacro" in codes(write(f"{left}{LINKS}{JOINT}</robot>", whole=True))

    def test_an_unknown_joint_in_a_transmission_is_reported(self, write):
        text = LINKS + JOINT + '<transmission name="t"><joint name="jj"/></transmission>'
        assert "unknown-transmission-joint" in codes(write(text))


class TestSafety:
    @pytest.mark.parametrize(
        "name", ["it's", 'a"b', "a\nb", "{{ 7*7 }}", "class", "../../etc", "Ellenbögen", "关节"]
    )
    def test_hostile_names_are_only_names(self, write, name):
        escaped = name.replace('"', "&quot;").replace("\n", "&#10;")
        robot = read_urdf(write(LINKS + joint(name=escaped)))
        assert robot.joints[0].name == name
        assert all("\n" not in each.where + each.message for each in robot.diagnostics)

    def test_external_files_are_never_opened(self, write, tmp_path):
        (tmp_path / "secret").write_text("secret")
        document = (
            f'<!DOCTYPE r [<!ENTITY x SYSTEM "{tmp_path}/secret">]><robot name="&x;">{LINKS}{JOINT}</robot>'
        )
        assert "document type or entity declaration" in refusal(write(document, whole=True))

    def test_deep_documents_are_refused(self, write):
        assert "not well-formed XML" in refusal(write("<a>" * 5000 + "</a>" * 5000))

    def test_huge_files_and_too_many_links_are_refused(self, write):
        assert refusal(write(LINKS + JOINT + " " * 20_000_000)).endswith(
            "; keep meshes in files of their own"
        )
        links = "".join(f'<link name="l{i}"/>' for i in range(2001))
        assert refusal(write(links)) == "FILE:1: <robot>: got 2001 links, expected at most 2000"

    @pytest.mark.parametrize(("kind", "bodies"), [("revolute", None), ("fixed", 1)])
    def test_three_hundred_joints_are_lumped_or_refused_in_seconds(self, write, kind, bodies):
        links = "".join(f'<link name="l{i}">{INERTIAL}</link>' for i in range(301))
        turned = '<origin xyz="0.1 0.2 0.3" rpy="0.1 0.2 0.3"/><axis xyz="0.1 0.2 0.3"/>'
        joints = "".join(
            joint(turned, name=f"j{i}", kind=kind if i else "revolute", parent=f"l{i}", child=f"l{i + 1}")
            for i in range(300)
        )
        begin = time.process_time()
        robot = read_urdf(write(links + joints))
        if bodies is None:
            with pytest.raises(ArmError, match="got 300 joints, expected at most 16"):
                make_arm(robot)
        else:
            assert len(make_arm(robot).bodies) == bodies
        assert in_time(time.process_time() - begin, 5)

    @given(data=st.data())
    @settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
    def test_damaged_bytes_are_read_or_refused(self, write, shared, data):
        whole = (shared / "arms" / "abb_irb6640.urdf").read_bytes()
        at = data.draw(st.integers(0, len(whole)))
        cut = data.draw(st.integers(0, 40))
        damaged = whole[:at] + data.draw(st.binary(max_size=8)) + whole[at + cut :]
        try:
            make_arm(read_urdf(write(damaged, whole=True)))
        except SpelgenError as error:
            assert "robot.urdf" in str(error)


def codes(path):
    return [diagnostic.code for diagnostic in read_urdf(path).diagnostics]


def refusal(path):
    with pytest.raises(SpelgenError) as told:
        read_urdf(path)
    return str(told.value).replace(str(path), "FILE")


def test_lengths_friction_and_reductions_that_are_implausible_are_named(robots, tmp_path):
    """`load_arm` reports a centre of mass outside the arm, friction above the effort limit, and ignored reductions.

    Gear reductions in the URDF are used only if the settings have `torque: motor`; a message states that they are not.
    """
    text = (robots / "two_link.urdf").read_text()
    codes = {x.code for x in load_arm(robots / "two_link.urdf").diagnostics}
    assert codes.isdisjoint({"millimetres", "friction-above-effort", "reduction"})
    text = re.sub(r'(<inertial>\s*<origin xyz=")[^"]*', r"\g<1>0 12.5 0", text, count=1)
    text = re.sub(r'(<limit [^>]*effort=")[^>]*/>', r'\g<0><dynamics friction="900"/>', text)
    ros = (
        '<transmission name="a"><type>SimpleTransmission</type><joint name="joint1"/>'
        '<actuator name="m"><mechanicalReduction>50</mechanicalReduction></actuator></transmission>'
    )
    ros2 = (
        '<ros2_control name="x"><transmission name="b"><plugin>transmission_interface/SimpleTransmission</plugin>'
        '<joint name="joint2"><mechanical_reduction>-80</mechanical_reduction></joint></transmission></ros2_control>'
    )
    (tmp_path / "arm.urdf").write_text(text.replace("</robot>", ros + ros2 + "</robot>"))
    arm = load_arm(tmp_path / "arm.urdf")
    messages = {x.code: x.message for x in arm.diagnostics}
    assert "a centre of mass at 12.5 m, of an arm with joints within" in messages["millimetres"]
    assert "a friction of 900 above the effort limit 50" in messages["friction-above-effort"]
    assert "(joint1 50, joint2 -80): logged torques are taken as joint torques" in messages["reduction"]
    (tmp_path / "arm.yaml").write_text("torque: motor\n")
    arm = load_arm(tmp_path / "arm.urdf")
    assert "reduction" not in {x.code for x in arm.diagnostics}
    assert arm.actuation.matrix().diagonal().tolist() == [50, -80]
