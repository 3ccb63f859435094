"""*.xacro files are expanded by the package xacro and read like the expanded text; other files are never expanded."""

import importlib.util
import shutil
import subprocess
import sys
import time

import numpy as np
import pytest

from spelgen.arm.configured_arm import load_arm
from spelgen.certificate.module_check import check
from spelgen.emission.plan import derive_spec
from spelgen.emission.specify import arm_of_spec, generate
from spelgen.errors import SpelgenError
from spelgen.fitting.run_folder import RunFolder
from spelgen.fitting.train import train
from spelgen.logs.read import write_logs
from spelgen.logs.trajectory import Trajectory
from spelgen.settings.fits import Rollout
from spelgen.simulation.as_built import urdf_without
from spelgen.urdf import xacro_input
from spelgen.urdf.document import urdf_bytes
from spelgen.urdf.read import read_urdf

ARM = """<?xml version="1.0"?>
<!-- a comment
     of two lines -->
<robot name="arm" xmlns:xacro="http://www.ros.org/wiki/xacro">
  <xacro:include filename="parts/segment.xacro"/>
  <xacro:arg name="length" default="0.5"/>
  <link name="base"/>
  <xacro:segment number="1" parent="base"/>
  <xacro:segment number="2" parent="link1"/>
</robot>
"""
SEGMENT = """<robot xmlns:xacro="http://www.ros.org/wiki/xacro">
  <xacro:macro name="segment" params="number parent">
    <xacro:property name="l" value="$(arg length)"/>
    <link name="link${number}">
      <inertial>
        <mass value="${2 * l}"/><origin xyz="${l / 2} 0 0"/>
        <inertia ixx="0.01" ixy="0" ixz="0" iyy="0.02" iyz="0" izz="0.02"/>
      </inertial>
    </link>
    <joint name="joint${number}" type="continuous">
      <parent link="${parent}"/><child link="link${number}"/>
      <origin xyz="${l} 0 0" rpy="0 ${pi / 2} 0"/><axis xyz="0 1 0"/>
    </joint>
  </xacro:macro>
</robot>
"""
JOINT = '<joint name="f" type="{}"><parent link="link2"/><child link="x"/></joint>'

installed = pytest.mark.skipif(
    importlib.util.find_spec("xacro") is None,
    reason="the package xacro (pip install spelgen[xacro]) is absent",
)


@pytest.fixture
def arm(tmp_path):
    """Write an arm in xacro with a macro in a file of its own; return its path."""
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / "segment.xacro").write_text(SEGMENT)
    path = tmp_path / "arm.urdf.xacro"
    path.write_text(ARM)
    return path


@installed
class TestExpansion:
    def test_is_read_like_the_document_that_the_command_prints(self, arm, tmp_path):
        command = [sys.executable, "-c", "import xacro; xacro.main()", str(arm)]
        printed = subprocess.run(command, capture_output=True, text=True, check=True).stdout
        plain = tmp_path / "plain.urdf"
        plain.write_text(printed)
        ours, theirs = read_urdf(arm), read_urdf(plain)
        assert (ours.links, ours.joints) == (theirs.links, theirs.joints), "names, numbers and lines"
        assert [joint.name for joint in ours.joints] == ["joint1", "joint2"]
        assert ours.link["link2"].inertial.mass == 1.0

    def test_messages_name_the_file_of_each_line(self, arm):
        (told,) = [each for each in read_urdf(arm).diagnostics if each.code == "expanded-xacro"]
        assert told.message == (
            "expanded by xacro: lines are those of the document that `xacro arm.urdf.xacro` prints"
        )
        arm.write_text(ARM.replace('parent="link1"', 'parent="link9"'))
        expected = (
            f"{arm} (expanded):30: joint 'joint2' parent: no link is named 'link9'; did you mean 'link2'?"
        )
        assert refusal(arm) == expected

    def test_errors_of_the_arm_name_the_expanded_document(self, arm):
        arm.write_text(ARM.replace("</robot>", '<link name="x"/>' + JOINT.format("floating") + "</robot>"))
        with pytest.raises(
            SpelgenError, match=r"arm\.urdf\.xacro \(expanded\):\d+: joint 'f': got a floating joint"
        ):
            load_arm(arm, joints=["f"])

    def test_warnings_of_xacro_are_passed_on(self, arm):
        arm.write_text(ARM.replace("<link", '<xacro:property name="pi" value="3"/><link'))
        (warning,) = [each for each in read_urdf(arm).diagnostics if each.code == "xacro-warning"]
        assert warning.message == "redefining global symbol: pi"

    def test_simulated_arms_are_of_the_expanded_document(self, arm):
        """URDFs that `compare` and `simulate --as-built` write are made from the expanded document."""
        root = urdf_without(arm, "inertial")
        assert {element.tag for element in root.iter()} == {
            "robot", "link", "joint", "parent", "child", "origin", "axis",
        }  # fmt: skip
        assert [link.get("name") for link in root.iter("link")] == ["base", "link1", "link2"]

    def test_gives_the_same_bytes_from_every_folder(self, arm, monkeypatch):
        absolute = urdf_bytes(arm)
        monkeypatch.chdir(arm.parent)
        assert urdf_bytes(arm.relative_to(arm.parent)) == absolute
        assert read_urdf(arm).digest in generate(arm.relative_to(arm.parent))

    def test_a_change_in_an_included_file_makes_a_module_stale(self, arm):
        module = arm.parent / "arm_model.py"
        module.write_text(generate(arm))
        assert check(module).fresh
        (arm.parent / "parts" / "segment.xacro").write_text(SEGMENT.replace("0.02", "0.03"))
        assert f"{arm} has changed since the module was built" in check(module).reasons

    @pytest.mark.parametrize("place", ["above", "beside", "without-manifest", "other-repository"])
    def test_packages_above_the_file_are_found_without_ros(self, arm, tmp_path, place):
        package = tmp_path / "ws" / ("vendor" if place == "other-repository" else "")
        package /= "my_arm" if place != "above" else "checkout"
        (package / "urdf").mkdir(parents=True)
        if place != "without-manifest":
            (package / "package.xml").write_text("<package><name> my_arm </name></package>")
        shutil.copytree(arm.parent / "parts", package / "urdf" / "parts")
        (package / "urdf" / "part.xacro").write_bytes(arm.read_bytes())
        other = tmp_path / "ws" / "app" if place in ("beside", "other-repository") else package
        (other / "robots").mkdir(parents=True, exist_ok=True)
        top = other / "robots" / "top.urdf.xacro"
        top.write_text(
            '<robot xmlns:xacro="http://www.ros.org/wiki/xacro" name="top">'
            '<xacro:include filename="$(find my_arm)/urdf/part.xacro"/></robot>'
        )
        assert load_arm(top).chain.joint_names == load_arm(arm).chain.joint_names

    def test_the_current_folder_does_not_replace_the_package(self, arm, monkeypatch):
        (arm.parent / "xacro.py").write_text("raise SystemExit('a foreign module')")
        monkeypatch.chdir(arm.parent)
        assert b'name="link2"' in urdf_bytes(arm)
        assert "xacro" not in sys.modules, "it is run in a process of its own"


FAILURES = {
    "unknown macro": ("<xacro:gripper/>", "unknown macro name: xacro:gripper when processing file: "),
    "missing file": ('<xacro:include filename="none.xacro"/>', "No such file or directory: "),
    "unknown package": (
        '<xacro:include filename="$(find no_pkg)/x.xacro"/>',
        "the package 'no_pkg' of $(find no_pkg) is neither",
    ),
    "wrong expression": ('<link name="${1 / 0}"/>', "division by zero when evaluating expression '1 / 0'"),
    "unset argument": ('<link name="$(arg side)"/>', "Undefined substitution argument side"),
    "not well-formed": ("<link>", "mismatched tag: line 10, column 2"),
    "macro of itself": (
        '<xacro:macro name="m"><xacro:m/></xacro:macro><xacro:m/>',
        "maximum recursion depth exceeded",
    ),
}


@installed
@pytest.mark.parametrize("case", FAILURES)
def test_a_failure_of_xacro_is_reported_in_one_line(arm, case):
    text, reason = FAILURES[case]
    arm.write_text(ARM.replace('<link name="base"/>', text))
    told = refusal(arm)
    assert told.startswith(f"{arm}: xacro cannot expand it (")
    assert reason in told
    assert told.endswith(
        "; correct it, or expand it where that works: xacro FILE name:=value ... > ROBOT.urdf"
    )
    assert "\n" not in told


@installed
def test_a_file_of_macros_is_named_as_one(arm):
    library = arm.with_name("macros.xacro")
    library.write_text(ARM.split("\n")[0] + "<robot xmlns:xacro='http://www.ros.org/wiki/xacro'>"
                       "<xacro:macro name='m' params='x'><link name='${x}'/></xacro:macro></robot>")  # fmt: skip
    assert refusal(library).endswith(
        "; this xacro file only defines macros or properties: name the xacro file that includes it"
    )


@installed
def test_time_and_memory_are_bounded(arm, monkeypatch):
    monkeypatch.setattr(xacro_input, "MAX_SECONDS", 2)
    arm.write_text(ARM.replace('"0.5"', '"${9**9**9}"'))
    started = time.monotonic()
    assert refusal(arm).startswith(f"{arm}: xacro still running after 2 s; expand it where that works")
    assert time.monotonic() - started < 30  # the endless expansion is stopped
    arm.write_text(ARM.replace('"0.5"', "\"${'x' * 2**31}\""))
    assert "xacro cannot expand it (" in refusal(arm)


@installed
def test_output_of_xacro_is_bounded(arm, monkeypatch):
    monkeypatch.setattr("spelgen.urdf.document.MAX_BYTES", 800)
    assert refusal(arm).endswith("bytes of URDF from xacro, expected at most 800")


def test_without_the_package_one_error_states_how_to_install_it(arm, tmp_path, monkeypatch):
    (tmp_path / "empty").mkdir()
    (tmp_path / "empty" / "xacro.py").write_text("raise ModuleNotFoundError(name='xacro')")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path / "empty"))
    assert refusal(arm) == (
        f"{arm}: a xacro file, and no package to expand it; pip install 'spelgen[xacro]', or expand it where "
        "that works: xacro FILE name:=value ... > ROBOT.urdf"
    )


@pytest.mark.parametrize("name", ["arm.urdf", "arm.xml", "arm.xacro.urdf", "xacro"])
def test_content_never_causes_expansion(arm, name, monkeypatch):
    """Only the suffix .xacro causes an expansion; the content of a file, which may be from elsewhere, does not."""
    monkeypatch.setattr("subprocess.run", lambda *_, **__: pytest.fail("it was run"))
    path = arm.rename(arm.with_name(name))
    lines = refusal(path).splitlines()
    assert len(lines) == 4
    assert all("got xacro that was not expanded, expected plain URDF; expand the" in line for line in lines)


def test_entities_are_refused_before_anything_is_run(arm, monkeypatch):
    monkeypatch.setattr("subprocess.run", lambda *_, **__: pytest.fail("it was run"))
    arm.write_text('<!DOCTYPE robot [<!ENTITY a "b">]>' + ARM.partition("\n")[2])
    assert "got a document type or entity declaration" in refusal(arm)


def refusal(path) -> str:
    with pytest.raises(SpelgenError) as told:
        read_urdf(path)
    return str(told.value)


@installed
def test_a_module_built_from_xacro_trains_with_its_robot(arm, tmp_path):
    """A module that is built from xacro is trained with the expanded URDF, which the run keeps.

    The regularizer towards the URDF reads it as well.
    """
    (tmp_path / "module.py").write_text(generate(arm, width=8, depth=1))
    t = np.arange(40) / 40.0
    q = np.stack([np.sin(3 * t), np.cos(2 * t)], axis=1)
    log = Trajectory(t, q, np.gradient(q, t, axis=0), q)
    write_logs(tmp_path / "log.parquet", [log], ["joint1", "joint2"])
    config = Rollout(epochs=1, momentum_steps=0)
    fit = train(tmp_path / "module.py", [tmp_path / "log.parquet"], tmp_path / "run", config, urdf=arm)
    assert not [x for x in fit.diagnostics if x.code in ("no-urdf", "changed-urdf", "no-regularizer")]
    assert read_urdf(tmp_path / "run" / "robot.urdf").digest == fit.model.spec.urdf_sha256
    spec = RunFolder(tmp_path / "run").read_spec()
    assert (
        derive_spec(arm_of_spec(spec, tmp_path / "run" / "robot.urdf"), spec.options).outputs == spec.outputs
    )
