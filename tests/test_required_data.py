"""A command refuses missing or wrong data only if it needs them."""

from pathlib import Path

import pytest

from spelgen.arm.configured_arm import load_arm
from spelgen.comparison.arms import ComparedArm, arm_inputs
from spelgen.emission.specify import generate
from spelgen.errors import SettingsError, SpelgenError
from spelgen.simulation.as_built import as_built

TRANSMISSION = """<transmission name="drive"><type>transmission_interface/SimpleTransmission</type>
<joint name="joint1"><mechanicalReduction>{} </mechanicalReduction></joint>
<actuator name="motor"><mechanicalReduction>fifty</mechanicalReduction></actuator></transmission>"""
FIXED = """<link name="plate"/><joint name="mount" type="fixed"><parent link="link3"/><child link="plate"/>
<axis xyz="up"/><limit lower="none" upper="0"/><dynamics damping="?"/><mimic joint="nobody"/></joint>"""
DECORATION = """<gazebo reference="nobody"><sensor type="camera"><rate>abc</rate></sensor></gazebo>
<material name=""/><sensor/><link name="shell"><visual><origin xyz="a"/><geometry><mesh filename="no.dae"/></geometry>
</visual><collision/></link><joint name="skin" type="fixed"><parent link="link3"/><child link="shell"/></joint>"""


@pytest.fixture
def odd(robots, tmp_path, monkeypatch):
    """Return a function that writes rpr.urdf and its settings file, and returns the path of the URDF.

    Its arguments are `more`, XML that is added at the end of the URDF, such as further links, and `sidecar`, the text
    of the settings file.
    """
    monkeypatch.chdir(tmp_path)

    def write(more="", sidecar=""):
        text = (robots / "rpr.urdf").read_text()
        (tmp_path / "rpr.urdf").write_text(text.replace("</robot>", f"{more}\n</robot>"))
        (tmp_path / "rpr.yaml").write_text(sidecar)
        return "rpr.urdf"

    return write


def body(source):
    """Return the lines of a module without the digests of its sources."""
    return [line for line in source.splitlines() if "sha256" not in line]


@pytest.mark.parametrize(
    ("more", "sidecar", "codes"),
    [
        (TRANSMISSION.format("nan"), "", ["unusable-value", "unusable-value"]),
        (FIXED, "", ["unusable-value"] * 3),
        (DECORATION, "", []),
        ("", "training: {epochs: many}\nlogs: {units: {q: grad}}", ["unusable-settings"] * 2),
        ("", "simulation: {positions: {nobody: [0, 1]}}", ["unusable-settings"]),
    ],
)
def test_unneeded_defects_are_warnings_at_most(odd, more, sidecar, codes):
    plain = generate(odd())
    arm = load_arm(odd(more, sidecar))
    assert [each.code for each in arm.diagnostics if each.severity == "warning"] == codes
    assert body(generate(arm)) == body(plain)


@pytest.mark.parametrize("group", ["simulation", "tracking"])
def test_settings_with_errors_are_not_copied(odd, tmp_path, group):
    """Two functions that copy the settings file of an arm refuse an unknown key in the settings group `group`.

    `as_built` writes no URDF of a perturbed arm, and `arm_inputs` (for a comparison of models) does not copy the arm.
    """
    urdf = odd(sidecar=f"{group}: {{lenght: 1}}")
    expected = f"{group}: unknown key 'lenght'"
    with pytest.raises(SettingsError, match=expected):
        as_built(load_arm(urdf), 1, tmp_path / "built.urdf")
    with pytest.raises(SettingsError, match=expected):
        arm_inputs(ComparedArm(urdf=Path(urdf)), tmp_path)
    assert not (tmp_path / "built.urdf").exists()


def test_couplings_of_locked_joints_are_not_needed(odd):
    sidecar = "torque: motor\ncouplings: [{joints: [joint2, joint3], matrix: [[1, 1], [1, -1]]}]"
    assert load_arm(odd(sidecar=sidecar), joints=["joint1"]).actuation.matrix().tolist() == [[1.0]]


@pytest.mark.parametrize(
    ("more", "sidecar", "message"),
    [
        (
            TRANSMISSION.format(2),
            "torque: motor",
            "rpr.urdf:56: transmission 'drive' mechanicalReduction: got 'fifty', "
            "expected one number in decimal notation",
        ),
        ("", "gravity: [0, 0]", "rpr.yaml:1: gravity.2: got [0, 0], expected a value"),
        (
            FIXED.replace("fixed", "revolute"),
            "",
            "rpr.urdf:55: joint 'mount' dynamics damping: got '?', expected one number in decimal notation",
        ),
    ],
)
def test_needed_defects_are_refused(odd, more, sidecar, message):
    with pytest.raises(SpelgenError) as error:
        load_arm(odd(more, sidecar))
    assert message in str(error.value).splitlines()
